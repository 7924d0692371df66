"""The profile of the likelihood along one driver's effect, all of the motor fitted for each size.

Derivation: docs/derivations.md, section 13.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import fminbound

from smp_motor_control.arrays import Array
from smp_motor_ident.estimation import driver_joint
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.descent import ROUGHLY, initial_of, refine
from smp_motor_ident.estimation.driver_effect import DriverFit
from smp_motor_ident.estimation.driver_rows import (
    commands_of,
    emf_share,
    rows_of,
    under_drag,
    with_voltages,
)
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.selection import sandwich_factor
from smp_motor_ident.likelihood.driver_feedback import terminal_voltages
from smp_motor_ident.likelihood.experiments import Experiments, prepare
from smp_motor_ident.model.driver import DRAG, Driver, DriverEffect
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
FEW = 12  # passes of a descent while the size is sought


def prepared(group: Sequence[Record], hold: str, fit: Fit) -> Experiments:
    """Return records as a fit sees them."""
    return of_kind(prepare(group, fit.structure.current, hold=hold), fit)


def applied(records: Sequence[Record], fit: Fit, driver: Driver) -> list[Record]:
    """Return records with the voltage of a driver that follows the motion."""
    data = commands_of(records, fit)
    voltage = driver_joint.voltage_of(data, fit, driver)
    return with_voltages(records, driver_joint.rows_of(data, voltage))


class Profile:
    """The profile of the likelihood along one effect's size."""

    numbers = 1

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
            prepared(group, hold, fit),
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
            data = prepared(records, self.hold, self.near)
            if self._loads_winding:
                records = under_drag(records, data, fit, size, turn == 0)
                data = prepared(records, self.hold, self.near)
            start = fit.at(fit.z, initial_of(data, fit))
            fit = solve(data, fit.structure, start, self.options, passes, ROUGHLY, known)
        return fit, data, records

    @property
    def _loads_winding(self) -> bool:
        """Whether the effect is a load of a motor of which the winding shows."""
        return self.effect.kind == DRAG and self.near.structure.order == 2

    def _voltage(self, size: float, data: Experiments, fit: Fit, first: bool) -> Array:
        """Return what the driver puts out, row by row, for the motion as measured or as it is run.

        A motion that was taken as given may be one that none of it leads to.
        """
        if first:
            rows = rows_of(data, self.group, fit, measured=self.follows)
            return rows.through(Driver(self.effect.kind, size, rows.full_duty))
        driver = Driver(self.effect.kind, size, self.full_duty, emf_share(fit))
        voltage = terminal_voltages(self.commands, fit.structure, fit.z, fit.initial, driver)
        return driver_joint.rows_of(self.commands, voltage)

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
        near = replace(self.near, initial=prepared(group, self.hold, self.near).initial)
        more = Profile(group, self.hold, near, self.options, self.effect)
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
            if not np.isfinite(fit.deviance):
                return None
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
        data = prepared(self.beside, self.hold, fit)
        return [refine(data, fit.structure, fit, fit.z, self.options).z.array - fit.z.array]

    def applied(self, records: Sequence[Record], fit: Fit) -> list[Record]:
        """Return other records of the motor with the voltage at the terminals."""
        if self.effect.follows_motion:
            driver = self.driver._replace(emf_share=emf_share(fit))
            behind = applied(records, fit, driver)
            if not self._loads_winding:
                return behind
            return under_drag(behind, prepared(behind, self.hold, fit), fit, driver.size)
        rows = rows_of(prepared(records, self.hold, fit), records, fit)
        return with_voltages(records, rows.through(self.driver))

    def _beside(self, x: float, away: float) -> tuple[float, float, bool]:
        """Return the deviances so many e-folds of the size below and above, if settled."""
        low, high = (self.at(float(np.exp(x + s * away)))[0] for s in (-1, 1))
        return low.deviance, high.deviance, low.converged and high.converged
