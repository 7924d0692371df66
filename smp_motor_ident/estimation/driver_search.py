"""A driver's effect on its command, estimated beside the motor: the likeliest of a table.

The size is sought along the profile of the likelihood, all of the motor fitted again for each; of
a driver that coasts together with the motor.

Derivation: docs/derivations.md, section 13.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import fminbound

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import COLOURED
from smp_motor_ident.estimation import fast_decay
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.descent import (
    ROUGHLY,
    SCREENING_SAMPLES,
    initial_of,
    refine,
)
from smp_motor_ident.estimation.driver_effect import DriverFit
from smp_motor_ident.estimation.driver_rows import (
    commands_of,
    emf_share,
    pieces,
    rows_of,
    under_drag,
    with_voltages,
)
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.selection import POLICY, sandwich_factor
from smp_motor_ident.estimation.thinning import thinned
from smp_motor_ident.likelihood.driver_feedback import terminal_voltages
from smp_motor_ident.likelihood.experiments import Experiments, prepare
from smp_motor_ident.model.driver import CURRENT, DRAG, EFFECTS, SLEW, Driver, DriverEffect
from smp_motor_ident.model.structures import FirstOrder
from smp_motor_ident.record import Record

# Turns of a motion that the effect asks for, and that follows from it: while a size is sought, and
# at the likeliest; a drag of a fifth of the voltage is off by some hundredths after three
TURNS, SETTLED = 3, 6
NEAR = 0.02  # e-folds of the size at which its deviance is first looked at beside the best
RISE = 2.0  # of the deviance on both sides together, from which its curvature is read
PARABOLAS = 8  # that are laid through it at most
CLOSE = 0.2  # standard deviations within which a size is the likeliest
MOST = 25  # sizes that are tried between those of the table
AROUND = 0.3  # e-folds of the size that these may be off by
FINALISTS = 3  # that are held against each other on all of them
FEW = 12  # passes of a descent while the size is sought


def likeliest(
    group: Sequence[Record],
    fit: Fit,
    hold: str,
    options: Options,
    effects: Sequence[DriverEffect] = EFFECTS,
) -> DriverFit | None:
    """Return the effect that explains the records best; None where none is worth its number."""
    step = group[0].sample_time
    few = pieces(group, step, fit.z.time_constant)
    price, factor = POLICY.price(1, fit.samples), sandwich_factor(fit)

    def cost(one: DriverFit) -> float:
        return one.cost(price, factor)

    plain = fit.deviance / factor + price * fit.structure.size
    without = refine(_prepared(few, hold, fit), fit.structure, fit, fit.z, options, ROUGHLY)
    behind = POLICY.hopeless * factor
    most = without.deviance + behind
    known: list[tuple[Fit, str]] = []
    profiles = [
        _Profile(few, how, start, options, effect)
        for effect in effects
        if effect.shares
        for start, how in _starts(few, fit, hold, options, effect, known)
    ]
    joints = [_Joint(few, list(group), fit, options, e) for e in effects if not e.shares]
    found = _polished(profiles, joints, most, behind)
    if found and sum(map(len, few)) < sum(map(len, group)):
        least = min(d.fit.deviance for d in found)
        most = fit.deviance + behind
        every: list[DriverFit] = []
        for d in sorted(found, key=cost)[:FINALISTS]:
            if d.fit.deviance > least + behind:
                continue
            if (there := d.search.on(list(group), most, behind)) is not None:
                every.append(there)
                most = min(most, there.fit.deviance + behind)
        found = every
    shown = (d for d in found if d.shown and cost(d) < plain and d.beyond_chance(fit, price))
    found = sorted(shown, key=cost)
    if not found:
        return None
    best, *others = found
    near = [d.fit for d in others if cost(d) < cost(best) + price]
    if plain < cost(best) + price:  # there may be none of them
        near.append(fit)
    return replace(best, rivals=tuple(near))


def run_free(group: Sequence[Record], fit: Fit, hold: str, options: Options) -> Fit:
    """Return a fit without torque noise, which would stand for an effect."""
    if not fit.noise_ratio > 0:
        return fit
    fit = replace(fit, noise_ratio=0.0)
    return refine(_prepared(group, hold, fit), fit.structure, fit, fit.z, options)


def _polished(
    searches: Sequence[_Profile], joints: Sequence[_Joint], most: float, behind: float
) -> list[DriverFit]:
    """Return the likeliest sizes of the effects that are not far behind the best of them.

    Whether the best of them leaves colour is not asked of a limited current, which is as a bridge
    that coasts, nearly.
    """
    sought = [(s, size) for s in searches if (size := s.sought()) is not None]
    sought.sort(key=lambda one: one[0].near.deviance)
    found: list[DriverFit] = []
    for search, size in sought:
        if search.near.deviance > min((d.fit.deviance for d in found), default=math.inf) + behind:
            break
        if (one := search.polished(size, most)) is None:
            continue
        found.append(one)
        if search.effect.kind != CURRENT and joints:
            found += _coasting(joints, most, sandwich_factor(one.fit) > COLOURED.value)
            joints = ()
    return found + _coasting(joints, most, True)


def _coasting(searches: Sequence[_Joint], most: float, coloured: bool) -> list[DriverFit]:
    """Return the drivers that coast, those of several numbers only where others leave colour."""
    found: list[DriverFit] = []
    for search in sorted(searches, key=lambda s: s.effect.numbers):
        if (coloured or search.effect.numbers == 1) and (one := search.best(most)) is not None:
            found.append(one)
            coloured = coloured and sandwich_factor(one.fit) > COLOURED.value
    return found


def _starts(
    group: Sequence[Record],
    fit: Fit,
    hold: str,
    options: Options,
    effect: DriverEffect,
    known: list[tuple[Fit, str]],
) -> list[tuple[Fit, str]]:
    """Return the motors with which an effect's size is sought, and how the command was held.

    All that may stand for the effect is put back: a command that ran otherwise or comes late, of a
    limited rate a second lag; and friction, for which the effect may stand.
    Those that are ``known`` already, of another effect, are added to.
    """
    s = fit.structure
    if s.friction == "none" and "vc_plus" not in s.fixed:
        s = s.with_(friction="symmetric")
    prompt = s.with_(delay=s.delay and "delay" in s.fixed)
    plain = prompt.with_(held="before", shift=0.0)
    ways = [(s, hold), (plain, "held")]
    if effect.kind == SLEW:
        ways.append((prompt, hold))
        if s.order == 2 and not s.current:
            ways += [(FirstOrder.like(prompt), hold), (FirstOrder.like(plain), "held")]
    out = []
    for structure, how in (way for k, way in enumerate(ways) if way not in ways[:k]):
        one = next((k for k in known if (k[0].structure, k[1]) == (structure, how)), None)
        if one is None:
            near = replace(fit, structure=structure)
            data, z = _prepared(group, how, near), structure.complete(fit.z)
            one = refine(data, structure, near, z, options), how
            known.append(one)
        out.append(one)
    return out


def _prepared(group: Sequence[Record], hold: str, fit: Fit) -> Experiments:
    return of_kind(prepare(group, fit.structure.current, hold=hold), fit)


class _Profile:
    """The profile of the likelihood along one effect's size."""

    def __init__(
        self,
        group: list[Record],
        hold: str,
        fit: Fit,
        options: Options,
        effect: DriverEffect,
    ) -> None:
        self.group, self.hold, self.options, self.effect = group, hold, options, effect
        self.data, self.near, self.commands = (
            _prepared(group, hold, fit),
            fit,
            commands_of(group, fit),
        )
        self.full_duty = rows_of(self.data, group, fit).full_duty
        self.follows = effect.follows_motion
        self.size = math.nan  # logarithm of the likeliest, of those that were tried
        self.driver = Driver()
        self.beside: list[Record] = []  # with the voltage for a size one standard deviation greater

    def at(
        self, size: float, turns: int = SETTLED, passes: int = 30, known: Fit | None = None
    ) -> tuple[Fit, Experiments, list[Record]]:
        """Return the motor fitted for a size, and what it was fitted to."""
        data, fit, records = self.data, self.near, self.group
        for turn in range(turns if self.follows else 1):
            records = with_voltages(self.group, self._voltage(size, data, fit, turn == 0))
            data = _prepared(records, self.hold, self.near)
            if self._has_current:
                records = under_drag(records, data, fit, size, turn == 0)
                data = _prepared(records, self.hold, self.near)
            start = fit.at(fit.z, initial_of(data, fit))
            fit = solve(data, fit.structure, start, self.options, passes, ROUGHLY, known)
        return fit, data, records

    @property
    def _has_current(self) -> bool:
        """Whether the effect draws a current that is measured."""
        return self.effect.kind == DRAG and self.near.structure.current

    def _voltage(self, size: float, data: Experiments, fit: Fit, first: bool) -> Array:
        """Return what the driver puts out, row by row, for the motion as measured or as it is run.

        A motion that was taken as given may be one that none of it leads to.
        """
        if first:
            rows = rows_of(data, self.group, fit, measured=self.follows)
            return rows.through(Driver(self.effect.kind, size, rows.full_duty))
        driver = Driver(self.effect.kind, size, self.full_duty, emf_share(fit))
        voltage = terminal_voltages(self.commands, fit.structure, fit.z, fit.initial, driver)
        return fast_decay.rows_of(self.commands, voltage)

    def deviance(self, logarithm: float) -> float:
        """Return the deviance at a size's logarithm; the next fit begins from the best so far.

        One that does not come near that is given up; it was another voltage's, and no end of this.
        """
        best = replace(self.near, converged=False)
        fit, data, _ = self.at(float(np.exp(logarithm)), TURNS, FEW, best)
        if fit.deviance < self.near.deviance:
            self.near, self.data, self.size = fit, data, logarithm
        return fit.deviance if np.isfinite(fit.deviance) else 1e300

    def sought(self) -> float | None:
        """Return the logarithm of the likeliest size; None where none is likelier than none."""
        none = self.near.deviance
        rows = rows_of(self.data, self.group, self.near)
        grid = np.log(self.effect.scale(rows) * np.array(self.effect.shares))
        values = [self.deviance(x) for x in grid]
        k = int(np.argmin(values))
        ends = [2 * grid[0] - grid[1], *grid, 2 * grid[-1] - grid[-2]]
        low, high = sorted((float(ends[k]), float(ends[k + 2])))
        self._seek(low, high)  # also where it begins, between it and none
        return self.size if self.near.deviance < none - RISE else None

    def on(self, group: list[Record], most: float, behind: float) -> DriverFit | None:
        """Go on from the size that was found, with more records.

        That size is off by chance alone, which costs so many times more as there are rows more;
        where it costs far more than a deviance with that the effect is none of theirs.
        """
        near = replace(self.near, initial=_prepared(group, self.hold, self.near).initial)
        more = _Profile(group, self.hold, near, self.options, self.effect)
        if more.deviance(self.size) > most + behind * more.data.size / self.data.size:
            return None
        more._seek(self.size - AROUND, self.size + AROUND)
        return more.polished(self.size if math.isnan(more.size) else more.size, most)

    def _seek(self, low: float, high: float) -> None:
        fminbound(self.deviance, low, high, xtol=1e-2, maxfun=MOST, disp=0)

    def polished(self, x: float, most: float) -> DriverFit | None:
        """Go on to the bottom by parabolas through three deviances, whose curvature is its std.

        None where a parabola's bottom is beyond a deviance, or the size cannot be.
        """
        away, widest, here, best = NEAR, 1.0, x, None
        for _ in range(PARABOLAS):
            tried = self.at(float(np.exp(x)))
            if best is not None and tried[0].deviance > best[0].deviance:
                x, away = here, 0.25 * away  # no parabola so far around
                widest = away
            else:
                here, best = x, tried
            fit, data, records = best
            self.near, self.data = fit, data
            low, high, settled = self._beside(x, away)
            while low + high - 2 * fit.deviance < RISE and away < widest:
                away *= 2
                low, high, settled = self._beside(x, away)
            curved = max(low + high - 2 * fit.deviance, 0.1 * RISE)
            std = away * float(np.sqrt(2 * sandwich_factor(fit) / curved))
            move = 0.5 * away * (low - high) / curved
            if fit.deviance - 0.125 * (low - high) / curved * (low - high) > most:
                return None
            if abs(move) < CLOSE * std:
                break
            x += float(np.clip(move, -2 * away, 2 * away))
            away = min(max(std, 0.1 * NEAR), widest)
        if not (settled and fit.converged):  # the curvature is that of where descents ended
            std = max(std, away)
        self.size, size = here, float(np.exp(here))
        rows = rows_of(self.data, self.group, fit)
        if not self.effect.may_be(size, rows):
            return None
        self.driver = Driver(self.effect.kind, size, rows.full_duty)
        found = DriverFit(self.effect, self.driver, size * std, self.group, records, self, fit)
        unsure = math.hypot(min(std, widest), found.tolerance / size)
        self.beside = self.at(size * float(np.exp(unsure)))[2]
        return found

    def moves(self, fit: Fit) -> list[Array]:
        """Return the move of a motor with the size, one standard deviation of it."""
        data = _prepared(self.beside, self.hold, fit)
        return [refine(data, fit.structure, fit, fit.z, self.options).z.array - fit.z.array]

    def applied(self, records: Sequence[Record], fit: Fit) -> list[Record]:
        """Return other records of the motor with the voltage at the terminals."""
        if self.effect.follows_motion:
            driver = self.driver._replace(emf_share=emf_share(fit))
            behind = _applied(records, fit, driver)
            if not self._has_current:
                return behind
            return under_drag(behind, _prepared(behind, self.hold, fit), fit, driver.size)
        rows = rows_of(_prepared(records, self.hold, fit), records, fit)
        return with_voltages(records, rows.through(self.driver))

    def _beside(self, x: float, away: float) -> tuple[float, float, bool]:
        """Return the deviances so many e-folds of the size below and above, if settled."""
        low, high = (self.at(float(np.exp(x + s * away)))[0] for s in (-1, 1))
        return low.deviance, high.deviance, low.converged and high.converged


class _Joint:
    """A driver that coasts, sought together with the motor."""

    def __init__(
        self,
        group: list[Record],
        every: list[Record],
        fit: Fit,
        options: Options,
        effect: DriverEffect,
    ) -> None:
        self.group, self.near, self.options, self.effect = group, fit, options, effect
        self.every = every
        self.found: fast_decay.Joint | None = None

    def best(self, most: float) -> DriverFit | None:
        """Return the likeliest driver; None where there is none, or beyond a deviance."""
        # Pieces do not tell the back-EMF's share, which steady speeds do.
        data, few = thinned(commands_of(self.every, self.near)), commands_of(self.group, self.near)
        data = data if data.size <= SCREENING_SAMPLES else few
        supply = min(r.hardware.supply_voltage or 0.0 for r in self.group)
        full = max(float(np.abs(data.hold_value).max(initial=0.0)), supply)
        driver = Driver(self.effect.kind, 1.0, full)
        self.found = fast_decay.fitted(data, self.near, driver, self.options)
        if data is few or self.found is None:
            return self._driver_fit(self.found, data, most)
        return self._driver_fit(fast_decay.continued(few, self.found, self.options), few, most)

    def on(self, group: list[Record], most: float, behind: float) -> DriverFit | None:
        """Go on from there with more records."""
        data = commands_of(group, self.near)
        more = _Joint(group, group, self.near, self.options, self.effect)
        assert self.found is not None
        more.found = fast_decay.continued(data, self.found, self.options)
        return more._driver_fit(more.found, data, most)

    def _driver_fit(
        self, joint: fast_decay.Joint | None, data: Experiments, most: float
    ) -> DriverFit | None:
        if joint is None:
            return None
        records = with_voltages(self.group, fast_decay.rows_of(data, joint.voltage))
        fit = self._with_current(records, joint.fit) if self.near.structure.current else joint.fit
        if fit.deviance > most:
            return None
        return DriverFit(self.effect, joint.driver, joint.std[0], self.group, records, self, fit)

    def _with_current(self, records: list[Record], fit: Fit) -> Fit:
        """Return the motor that a measured current shows under the voltage that was found."""
        near, s = self.near, self.near.structure
        data = _prepared(records, "held", near)
        z = near.z.with_(ln_a0=fit.z.ln_a0, ln_a1=fit.z.ln_a1).with_friction(fit.z.vc_plus)
        tried = [refine(data, s, near, s.complete(z), self.options)]
        if other := initial_fit(data, s, self.options):
            tried.append(run_free(records, other, "held", self.options))
        return min(tried, key=lambda f: f.deviance)

    def moves(self, fit: Fit) -> list[Array]:
        """Return by how much less is known of a motor than under a voltage that is known."""
        return list(self.found.moves) if self.found else []

    def applied(self, records: Sequence[Record], fit: Fit) -> list[Record]:
        """Return other records of the motor with the voltage at the terminals."""
        assert self.found is not None
        return _applied(records, self.found.fit, self.found.driver)


def _applied(records: Sequence[Record], fit: Fit, driver: Driver) -> list[Record]:
    data = commands_of(records, fit)
    voltage = fast_decay.voltage_of(data, fit, driver)
    return with_voltages(records, fast_decay.rows_of(data, voltage))
