# SPDX-License-Identifier: Apache-2.0
"""Loop: the sampled loop for which gains are designed."""

import math
from dataclasses import dataclass, fields
from typing import Literal

from smp_motor_control.errors import ParameterError, check_range

SpeedSource = Literal["measured", "difference", "observer"]
SPEED_SOURCES: tuple[SpeedSource, ...] = ("measured", "difference", "observer")


@dataclass(frozen=True)
class Loop:
    """One wheel's speed loop: sampling, delay, encoder, gearbox and supply."""

    sample_time: float = 0.005  # interval of the controller's steps [s]
    # From the stamp of a measurement until its voltage is applied, without hold, motor [s]; None:
    # one sample, the delay of a node that answers within its period
    delay: float | None = None
    # Usual value of this delay [s], for the timing of the reference; ``delay`` is the longest one,
    # which the margins cover; None: ``delay``
    usual_delay: float | None = None
    delay_doubt: float = 2e-3  # additional delay without significant overshoot [s]
    gear_ratio: float = 65.5  # motor revolutions per wheel revolution [-]
    # Counts of the encoder per motor revolution; None if the speed is not made from counts
    counts_per_revolution: float | None = 500.0
    supply_voltage: float = 12.0  # largest voltage of either sign [V]
    # The speed in the message, counts differenced over ``difference_window``, or the observer's
    speed_source: SpeedSource = "measured"
    # Samples over which the speed is averaged: by the controller for ``difference``, by the
    # hardware for ``measured`` (0: an instantaneous speed, as of a tachometer)
    difference_window: int = 1
    noise_voltage: float | None = None  # largest control noise [V rms]; None: 4 % of the supply
    speed_noise: float = 0.0  # of a reported speed, with its rounding [rad/s rms, motor]
    speed_step: float = 0.0  # resolution of a reported speed [rad/s, motor]
    angle_noise: float = 0.0  # of the angle behind the speed, before counting [rad rms, motor]
    # Whether ``difference_window`` holds for a reported speed whatever averaging was identified
    averaging_given: bool = False

    def __post_init__(self) -> None:
        if self.speed_source not in SPEED_SOURCES:
            raise ParameterError(
                f"speed_source is {self.speed_source!r}; it must be one of "
                f"{', '.join(SPEED_SOURCES)}"
            )
        positive = ("sample_time", "gear_ratio", "counts_per_revolution", "supply_voltage")
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name in ("speed_source", "averaging_given") or value is None:
                continue
            check_range(entry.name, value, 1e-12 if entry.name in positive else 0.0, 1e12)
        if self.difference_window != int(self.difference_window):
            raise ParameterError(
                f"difference_window is {self.difference_window}; it must be a number of samples"
            )
        if self.speed_source == "difference" and self.difference_window < 1:
            raise ParameterError("difference_window is 0; a difference needs at least 1 sample")

    @property
    def rate(self) -> float:
        """Steps per second [Hz]."""
        return 1.0 / self.sample_time

    @property
    def reports_speed(self) -> bool:
        """Whether the reported speed is fed back, with the dynamics of its sensor."""
        return self.speed_source == "measured"

    @property
    def reported_noise(self) -> float:
        """Noise of the speed that is fed back [rad/s], without quantisation; 0 unless reported."""
        return self.speed_noise if self.reports_speed else 0.0

    @property
    def rounding(self) -> float:
        """Step [rad/s] of the speed that is fed back, where rounding dominates its noise.

        More noise dithers the rounding; differenced counts are rounded as angles, not as speeds.
        """
        rounded = self.reports_speed and 3.0 * self.speed_noise < self.speed_step
        return self.speed_step if rounded else 0.0

    @property
    def loop_delay(self) -> float:
        """Delay beyond the hold [s]: as given, or one sample."""
        return self.sample_time if self.delay is None else self.delay

    @property
    def expected_delay(self) -> float:
        """Delay beyond the hold that is usual [s]."""
        return self.loop_delay if self.usual_delay is None else self.usual_delay

    @property
    def noise_limit(self) -> float:
        """Largest control noise [V rms]: as given, or 4 % of the supply."""
        return 0.04 * self.supply_voltage if self.noise_voltage is None else self.noise_voltage

    @property
    def count_angle(self) -> float:
        """One encoder count [rad, motor]; 0 where speed is not made from counts."""
        counts = self.counts_per_revolution
        return 0.0 if counts is None else 2 * math.pi / counts
