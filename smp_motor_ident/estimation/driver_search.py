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
from scipy.special import chdtri

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import COLOURED, EFFECT_COVERED
from smp_motor_ident.diagnosis.sample_limits import BRAKES
from smp_motor_ident.estimation import driver_joint
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.descent import (
    ROUGHLY,
    SCREENING_SAMPLES,
    refine,
)
from smp_motor_ident.estimation.driver_effect import DriverFit
from smp_motor_ident.estimation.driver_profile import Profile, applied, prepared
from smp_motor_ident.estimation.driver_rows import (
    commands_of,
    pieces,
    rows_of,
    with_voltages,
)
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate, sandwich_factor
from smp_motor_ident.estimation.thinning import thinned
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.driver import (
    COAST,
    COASTING,
    CURRENT,
    DROP,
    EFFECTS,
    FREE,
    SLEW,
    Driver,
    DriverEffect,
    Rows,
)
from smp_motor_ident.model.structures import FirstOrder
from smp_motor_ident.record import Record

BRAKED = 5  # rows in which a motor runs ahead of its command, beyond which it brakes
DIODES = 1.0  # V that two diodes take, where what they do is begun
FINALISTS = 3  # that are held against each other on all of them


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
    without = refine(prepared(few, hold, fit), fit.structure, fit, fit.z, options, ROUGHLY)
    behind = POLICY.hopeless * factor
    most = without.deviance + behind
    known: list[tuple[Fit, str]] = []
    profiles, joints = list[Profile](), list[_Joint]()
    for effect in effects:
        for start, how in _starts(few, fit, hold, options, effect, known):
            if effect.feeds_back:
                joints.append(_Joint(few, list(group), start, options, effect))
            else:
                profiles.append(Profile(few, how, start, options, effect))
    found = _polished(profiles, joints, most, behind)
    if found and sum(map(len, few)) < sum(map(len, group)):
        least = min(d.fit.deviance for d in found)
        most = fit.deviance + behind
        every: list[DriverFit] = []
        likeliest_of = {d.effect: d for d in sorted(found, key=cost, reverse=True)}
        for d in sorted(likeliest_of.values(), key=cost)[:FINALISTS]:
            if d.fit.deviance > least + behind:
                continue
            if (there := d.search.on(list(group), most, behind)) is not None:
                every.append(there)
                most = min(most, there.fit.deviance + behind)
        found = every
    found = sorted((d for d in found if d.shown and cost(d) < plain + price), key=cost)
    likelier = [d for d in found if cost(d) < plain and d.beyond_chance(fit, price)]
    if not likelier:
        return _as_likely(found, fit.deviance - factor * float(chdtri(1, EFFECT_COVERED.value)))
    if free := next((d for d in likelier if d.effect.kind == FREE), None):
        # A drop that no back-EMF exceeds lets a motor coast, too, and takes what no driver does.
        most = cost(free) - price
        likelier = [d for d in likelier if d.effect.kind != DROP or cost(d) < most]
    best, *others = likelier
    near = [d.fit for d in others if cost(d) < cost(best) + price]
    if plain < cost(best) + price:  # there may be none of them
        near.append(fit)
    return replace(best, rivals=tuple(near))


def _as_likely(found: Sequence[DriverFit], most: float) -> DriverFit | None:
    """Return the first of what the records do not decide about, each a rival of a motor without it.

    It explains more than nothing would by chance.
    """
    left = [d for d in found if d.effect.kind not in COASTING and d.fit.deviance < most]
    words = "the records do not decide about it"
    rivals = [
        FittedCandidate(
            d.fit, words, on=d.search.data, behind=d.effect.cause, numbers=d.search.numbers
        )
        for d in left
    ]
    return replace(left[0], as_likely=tuple(rivals)) if left else None


def beside_driver(
    data: Experiments, driver: DriverFit, options: Options, candidates: list[FittedCandidate]
) -> list[FittedCandidate]:
    """Return candidates, the choice last, with the motor that was found together with a driver."""
    fit = driver.fit
    again = refine(of_kind(data, fit), fit.structure, fit, fit.z, options)
    found = FittedCandidate(again, f"as found with {driver.effect.cause}")
    better = POLICY.likelier(found, candidates[-1])
    return [*candidates, found] if better else [found, *candidates]


def run_free(group: Sequence[Record], fit: Fit, hold: str, options: Options) -> Fit:
    """Return a fit without torque noise, which would stand for an effect."""
    if not fit.noise_ratio > 0:
        return fit
    fit = replace(fit, noise_ratio=0.0)
    return refine(prepared(group, hold, fit), fit.structure, fit, fit.z, options)


def _polished(
    searches: Sequence[Profile], joints: Sequence[_Joint], most: float, behind: float
) -> list[DriverFit]:
    """Return the likeliest sizes of the effects that are not far behind the best of them.

    A driver that coasts is sought where the best of the others leaves colour, which of a drop or a
    limited current is not asked: these are as a bridge that coasts, nearly.
    """
    coasting = [j for j in joints if j.effect.kind in COASTING]
    found = [one for j in joints if j not in coasting and (one := j.best(most)) is not None]
    sought = [(s, size) for s in searches if (size := s.sought()) is not None]
    sought.sort(key=lambda one: one[0].near.deviance)
    for search, size in sought:
        if search.near.deviance > min((d.fit.deviance for d in found), default=math.inf) + behind:
            break
        if (one := search.polished(size, most)) is not None:
            found.append(one)
    best = min(found, key=lambda d: d.fit.deviance, default=None)
    coloured = best is None or best.effect.kind in (DROP, CURRENT) or _coloured(best)
    for joint in sorted(coasting, key=lambda j: j.effect.kind == COAST):  # of several numbers
        if (coloured or joint.effect.kind == FREE) and (one := joint.best(most)) is not None:
            found.append(one)
            coloured = coloured and _coloured(one)
    return found


def _brakes(rows: Rows) -> bool:
    """Tell whether the motor brakes now and then: of one that is only driven a drop is friction."""
    ahead = np.abs(rows.back_emf) - np.sign(rows.back_emf) * rows.command
    return int(np.count_nonzero(ahead > BRAKES.value * rows.top)) > BRAKED


def _coloured(found: DriverFit) -> bool:
    return sandwich_factor(found.fit) > COLOURED.value


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
            data, z = prepared(group, how, near), structure.complete(fit.z)
            one = refine(data, structure, near, z, options), how
            known.append(one)
        out.append(one)
    return out


class _Joint:
    """A driver that follows the motion, sought together with the motor."""

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
        self.found: driver_joint.Joint | None = None
        self.data = prepared(group, "held", fit)

    @property
    def numbers(self) -> int:
        """How many numbers of the driver were sought."""
        return len(self.found.numbers) if self.found else 0

    def best(self, most: float) -> DriverFit | None:
        """Return the likeliest driver; None where there is none, or beyond a deviance."""
        # Pieces do not tell the back-EMF's share, which steady speeds do.
        data, few = thinned(commands_of(self.every, self.near)), commands_of(self.group, self.near)
        data = data if data.size <= SCREENING_SAMPLES else few
        supply = min(r.hardware.supply_voltage or 0.0 for r in self.group)
        full = max(float(np.abs(data.hold_value).max(initial=0.0)), supply)
        driver = Driver(self.effect.kind, 1.0, full)
        rows = rows_of(prepared(self.group, "held", self.near), self.group, self.near)
        if self.effect.kind == DROP and not _brakes(rows):
            return None
        sizes = self.effect.scale(rows) * np.array(self.effect.shares)
        least = most if data is few else math.inf  # which is of those data
        self.found = driver_joint.fitted(
            data, self.near, driver, self.options, sizes.tolist(), least
        )
        if self.found and self.effect.kind == COAST and supply > 0:  # else they look like it
            self.found = self._with_diodes(data, self.found)
        if data is few or self.found is None:
            return self._driver_fit(self.found, data, most)
        return self._continued(few, self.found, most)

    def _with_diodes(self, data: Experiments, joint: driver_joint.Joint) -> driver_joint.Joint:
        """Return a bridge that is off now and then with what its diodes take, if that is more."""
        there, numbers = joint.driver._replace(diode_drop=DIODES), (*joint.numbers, "diodes")
        tried = driver_joint.continued(data, joint.fit, there, self.options, numbers)
        return tried if tried and tried.cost < joint.cost else joint

    def on(self, group: list[Record], most: float, behind: float) -> DriverFit | None:
        """Go on from there with more records."""
        data = commands_of(group, self.near)
        more = _Joint(group, group, self.near, self.options, self.effect)
        assert self.found is not None
        return more._continued(data, self.found, most)

    def _continued(
        self, data: Experiments, joint: driver_joint.Joint, most: float
    ) -> DriverFit | None:
        self.found = driver_joint.continued(
            data, joint.fit, joint.driver, self.options, joint.numbers
        )
        return self._driver_fit(self.found, data, most)

    def _driver_fit(
        self, joint: driver_joint.Joint | None, data: Experiments, most: float
    ) -> DriverFit | None:
        if joint is None:
            return None
        records = with_voltages(self.group, driver_joint.rows_of(data, joint.voltage))
        fit = self._with_current(records, joint.fit) if self.near.structure.current else joint.fit
        rows = rows_of(data, self.group, self.near)
        if fit.deviance > most or not self.effect.may_be(joint.driver.size, rows):
            return None
        self.data = prepared(records, "held", fit)
        return DriverFit(self.effect, joint.driver, joint.std, self.group, records, self, fit)

    def _with_current(self, records: list[Record], fit: Fit) -> Fit:
        """Return the motor that a measured current shows under the voltage that was found."""
        near, s = self.near, self.near.structure
        data = prepared(records, "held", near)
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
        return applied(records, self.found.fit, self.found.driver)
