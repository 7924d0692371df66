"""A motor whose current is measured: winding, rotor and friction, each by itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.second_order import SecondOrder
from smp_motor_ident.model.structure import Regressions, Structure

SENSORS = ("", "averaged", "low_passed", "smoothed")
"""What a sensor shows of the current: its value, its mean over a trailing window of twice
`current_lag`, a first-order low-pass of it of that time constant, or its values at the samples,
exponentially smoothed (a digital filter at the rate of the log) and late by that on average."""


@dataclass(frozen=True)
class Electromechanical(SecondOrder):
    """Voltage to speed and current: R, L, K, J, b and friction are all separated."""

    name = "electromechanical"
    current: ClassVar[bool] = True

    offset: bool = False  # whether the current's offset is a coordinate
    current_sensor: str = ""  # one of `SENSORS`

    @property
    def lags(self) -> bool:
        """Whether the measured current lags behind the current."""
        return self.current_sensor != ""

    def _response(self) -> tuple[str, ...]:
        return "ln_a0", "ln_a1", "ln_a2", "ln_te", "ln_r"

    def _added(self) -> Iterator[str]:
        yield from super()._added()
        yield from ["current_offset"] * self.offset + ["current_lag"] * self.lags

    def _words(self) -> Iterator[tuple[bool, str]]:
        *others, after, interpolated = super()._words()
        yield from others
        yield self.current_sensor == "averaged", "averaged current"
        yield self.current_sensor == "low_passed", "low-passed current"
        yield self.current_sensor == "smoothed", "smoothed current"
        yield self.offset, "current offset"
        yield from (after, interpolated)

    def guesses(self, regressions: Regressions) -> list[Coordinates]:
        """Return motors from voltage, current and speed, or without the current."""
        return regressions.current() or super().guesses(regressions)


def sensor_of(structure: Structure) -> str:
    """Return what the sensor shows of the current, one of `SENSORS`."""
    return structure.current_sensor if isinstance(structure, Electromechanical) else ""
