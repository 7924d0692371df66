# SPDX-License-Identifier: Apache-2.0
"""Compare the results of the demo with the truth: a table per wheel, and checks."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from smp_motor_control.motor.file import MotorEntry
from smp_motor_control.motor.parameters import COMBINATIONS, PHYSICAL
from smp_motor_ident.cli.driving import DesignSet
from smp_motor_ident.cli.tables import console, table
from smp_motor_ident.report import words
from smp_motor_ident.result import Estimate, Quantity
from smp_motor_ident.tune.verification import Change

MAX_OVERSHOOT = 2.0  # percent of the change
MAX_SETTLING_EXCESS = 20.0  # ms later than predicted: four samples
MAX_GAIN_ERROR = 0.5  # percent
MAX_DEVIATIONS = 3.0  # of its own standard deviations, for every parameter of a wheel
WORST_DEVIATIONS = 4.0
UNIT = "standard deviations, timing included,"  # the only systematic error of a simulation
# Of 40 numbers, some 26 of them independent, one lies beyond 3 by chance in one run of 15
# (and beyond 4 in one of 600): so one wheel may, and none may beyond 4.


GAINS = ("p", "i", "d", "feedforward_static", "feedforward_velocity", "feedforward_acceleration")
"""Parameters of a controller that are printed."""


@dataclass(frozen=True)
class Check:
    """One check of the demo: the worst figure, its limit, and its place."""

    name: str
    worst: float
    limit: float
    where: str
    unit: str

    @property
    def holds(self) -> bool:
        """Whether the figure exists and is within its limit."""
        return self.worst <= self.limit


def _compare_with_truth(entry: MotorEntry, estimate: Estimate) -> list[tuple[str, float, Quantity]]:
    """Return name, truth and estimate of every quantity that the estimate claims to know."""
    held = {**estimate.combinations, **estimate.parameters}
    names = (*COMBINATIONS, *PHYSICAL) if entry.knows_current else COMBINATIONS
    truth = {name: float(getattr(entry.parameters, name)) for name in names}
    return [(n, t, held[n]) for n, t in truth.items() if n in held and held[n].value is not None]


def print_results(
    truth: Mapping[str, MotorEntry],
    designed: DesignSet,
    changes: Mapping[str, Sequence[Change]],
) -> None:
    """Print one table per wheel."""
    out = console()
    for wheel, estimate in designed.estimates.items():
        title = f"{words.label(wheel)}: {words.model(estimate.model)}"
        made = table(title, "", "true", "identified", "error/std")
        compared = _compare_with_truth(truth[wheel], estimate)
        for name, true, quantity in compared:
            std, error = quantity.std or 0.0, (quantity.value or 0.0) - true
            made.add_row(
                name,
                words.state(Quantity(true, unit=quantity.unit)),
                words.state(quantity),
                f"{error / std:+.1f}" if std else "",
            )
        shares = (f"{n} {words.systematic(q)}" for n, _, q in compared if q.systematic)
        mine = designed.gains[wheel]
        text = ", ".join(f"{n} {mine[n]:.4g}" for n in GAINS if mine.get(n))
        columns = ("change", "to", "settling", "predicted", "overshoot", "predicted")
        driven = table("", *columns)
        for one in changes[wheel]:
            pairs = (one.reading, one.expected)
            settled = (f"{1e3 * x.settling:.0f} ms" for x in pairs)
            overshoot = (f"{x.overshoot:.2f} %" for x in pairs)
            driven.add_row(one.name, f"{one.setpoint:+.2f} rad/s", *settled, *overshoot)
        out.print(made)
        out.print(f"systematic: {'; '.join(shares) or 'none'}", soft_wrap=True)
        out.print(f"gains (volts, wheel rad/s): {text}", soft_wrap=True)
        out.print(driven)


def check_estimates(
    truth: Mapping[str, MotorEntry], estimates: Mapping[str, Estimate]
) -> list[Check]:
    """Check the identified motors against the limits."""
    gain, deviation = [], []
    beyond = set()
    for wheel in estimates:
        timing = next((s.moves for s in estimates[wheel].systematic if s.cause == "timing"), {})
        for name, true, quantity in _compare_with_truth(truth[wheel], estimates[wheel]):
            error = abs((quantity.value or math.nan) - true)
            if name == "dc_gain":
                gain.append((100.0 * error / true, wheel))
            if quantity.status == "estimated":
                std = math.hypot(quantity.std or 1e-300, timing.get(name, 0.0))
                deviations = error / std
                deviation.append((deviations, f"{wheel} {name}"))
                if not deviations <= MAX_DEVIATIONS:
                    beyond.add(wheel)
    return [
        _worst("error of the DC gain", gain, MAX_GAIN_ERROR, "%"),
        _worst("error of a parameter", deviation, WORST_DEVIATIONS, UNIT),
        Check("wheels with an error beyond 3", len(beyond), 1, ", ".join(beyond) or "-", "wheels"),
    ]


def check_drive(changes: Mapping[str, Sequence[Change]]) -> list[Check]:
    """Check the wheels' responses against the limits."""
    every = [(f"{wheel} {one.name}", one) for wheel, given in changes.items() for one in given]
    over = [(one.reading.overshoot, where) for where, one in every]
    late = [(1e3 * (one.reading.settling - one.expected.settling), where) for where, one in every]
    return [
        _worst("overshoot", over, MAX_OVERSHOOT, "%"),
        _worst("settling after its prediction", late, MAX_SETTLING_EXCESS, "ms"),
    ]


def _worst(name: str, found: Sequence[tuple[float, str]], limit: float, unit: str) -> Check:
    """Return the largest figure; one that does not exist (NaN), or none at all, is worst."""
    figure, where = max(
        found, key=lambda one: math.inf if math.isnan(one[0]) else one[0], default=(math.nan, "-")
    )
    return Check(name, figure, limit, where, unit)
