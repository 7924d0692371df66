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
    """One wheel's speed loop: sampling, delay, encoder, gearbox and supply.

    Attributes
    ----------
    sample_time : float
        Interval of the controller's steps [s].
    delay : float or None
        From the stamp of a measurement to the instant at which the voltage answering it is
        applied: computation and transport, beyond the hold [s].  None takes one sample, which
        every node that answers within its period keeps.  A delay of the motor itself (that of
        the estimate) is added to it.
    usual_delay : float or None
        The same as it usually is [s], for the timing of the reference, where ``delay`` is the
        longest that the margins must bear.  None takes ``delay``: a driver whose loop has a
        fixed rate applies at its next sample the last command in between.
    delay_doubt : float
        Increase of the delay that may not cause significant overshoot [s].
    gear_ratio : float
        Motor revolutions per wheel revolution [-].
    counts_per_revolution : float or None
        Encoder counts per motor revolution; None where speed is not made from counts.
    supply_voltage : float
        Largest voltage of either sign [V].
    speed_source : {'measured', 'difference', 'observer'}
        Source of the controlled speed: the speed in the message, counts differenced over
        ``difference_window`` samples, or the observer's estimate.
    difference_window : int
        Samples over which the speed is averaged: by the controller for ``difference``, by the
        hardware for ``measured`` (0: an instantaneous speed, as of a tachometer).
    noise_voltage : float or None
        Largest control noise [V rms] that the measurement may cause at the output;
        None takes 4 % of the supply.
    speed_noise : float
        Standard deviation of the noise on a reported speed [rad/s, motor], its rounding included.
    speed_step : float
        Step in which a reported speed comes [rad/s, motor].
    angle_noise : float
        Standard deviation of the noise on the angle that the speed is made from [rad, motor],
        in addition to quantisation.
    averaging_given : bool
        Whether ``difference_window`` holds for a reported speed whatever averaging was identified.

    Raises
    ------
    ParameterError
        When a value is not finite, has the wrong sign, or names no speed source.
    """

    sample_time: float = 0.005
    delay: float | None = None
    usual_delay: float | None = None
    delay_doubt: float = 2e-3
    gear_ratio: float = 65.5
    counts_per_revolution: float | None = 500.0
    supply_voltage: float = 12.0
    speed_source: SpeedSource = "measured"
    difference_window: int = 1
    noise_voltage: float | None = None
    speed_noise: float = 0.0
    speed_step: float = 0.0
    angle_noise: float = 0.0
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
        """Whether the speed of the message is fed back, with all that its sensor does to it."""
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
