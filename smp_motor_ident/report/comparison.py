# SPDX-License-Identifier: Apache-2.0
"""Compare wheels side by side: the intervals of each quantity on one axis."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from smp_motor_ident.report import words
from smp_motor_ident.report.drawing import ticks
from smp_motor_ident.result import Estimate, Quantity

COMPARED = (
    "dc_gain", "time_constant", "time_constant_product", "static_voltage", "delay", "resistance",
    "motor_constant",
)  # fmt: skip
"""Quantities compared between wheels, where known."""

MARGIN = 0.06  # share of the axis beyond the intervals


@dataclass(frozen=True)
class Interval:
    """One wheel's number on the axis; places are in percent of its length."""

    wheel: str
    text: str
    value: float | None = None
    # random, total: ends of the 95 % intervals without and with systematic uncertainty
    random: tuple[float, float] | None = None
    total: tuple[float, float] | None = None


@dataclass(frozen=True)
class Compared:
    """One quantity of all wheels."""

    name: str
    rows: Sequence[Interval]
    ticks: Sequence[tuple[float, str]]  # places and labels
    unit: str


def compare(estimates: Mapping[str, Estimate]) -> list[Compared]:
    """Return the quantities known for at least one wheel, side by side."""
    made = []
    for name in COMPARED:
        quantities = {
            wheel: words.scaled(quantity)
            for wheel, one in estimates.items()
            if (quantity := {**one.parameters, **one.combinations}.get(name)) is not None
        }
        if any(quantity.value is not None for quantity in quantities.values()):
            made.append(_place_on_axis(name, list(estimates), quantities))
    return made


def _place_on_axis(
    name: str, wheels: Sequence[str], quantities: Mapping[str, Quantity]
) -> Compared:
    """Return the intervals of all wheels on an axis that holds them with a margin."""
    known = [q for q in quantities.values() if q.value is not None]
    ends = [x for q in known for x in (q.value, *(q.total_ci95 or ())) if x is not None]
    finite = list(filter(math.isfinite, ends))
    low, high = min(finite), max(finite)
    margin = MARGIN * (high - low) or 1.0
    low, high = low - margin, high + margin

    def place(value: float) -> float:
        """Return the place of a value in percent of the axis; infinite ends leave it."""
        share = (min(max(value, low - margin), high + margin) - low) / (high - low)
        return round(100 * float(share), 2)

    def interval(wheel: str) -> Interval:
        quantity = quantities.get(wheel, Quantity(None))
        value, random, total = quantity.value, quantity.ci95, quantity.total_ci95
        return Interval(
            wheel,
            words.state(quantity),
            None if value is None else place(value),
            random and (place(random[0]), place(random[1])),
            total and (place(total[0]), place(total[1])),
        )

    marks = [(place(tick), f"{tick:g}") for tick in ticks(low, high, about=4)]
    unit = words.format_unit(next(iter(known)).unit)
    return Compared(words.label(name), [interval(wheel) for wheel in wheels], marks, unit)
