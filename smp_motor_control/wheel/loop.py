# SPDX-License-Identifier: Apache-2.0
"""Speed loop of one wheel: speed source, reference and PID.

Set-point and speeds are at the wheel; counts and the model are at the motor.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from smp_motor_control.encoder import CounterWidth, DifferencedSpeed, Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import check_limits, described, nested, optional
from smp_motor_control.motor.parameters import Gearbox, MotorModel
from smp_motor_control.observer import ObserverNoise, SpeedObserver
from smp_motor_control.pid import Pid, PidGains, PidOutput
from smp_motor_control.reference.profile import (
    Drive,
    Profile,
    ProfileLimits,
    Reference,
    ReferencePath,
)
from smp_motor_control.wheel.differenced import differenced_gains
from smp_motor_control.wheel.plausibility import PlausibleSpeed
from smp_motor_control.wheel.stop import MAX_STOP_TIME_S, Standstill

SPEED_SOURCES = ("measured", "difference", "observer")

MAX_TRANSITION_S = 60.0  # maximum duration of a change of set-point

INTERVAL_SAMPLES = 20  # number of samples from which the observer's interval is learnt


@dataclass(frozen=True, kw_only=True)
class LoopSettings:
    """Settings of the loop."""

    gains: PidGains = nested(PidGains())
    limits: ProfileLimits = nested(ProfileLimits())  # of the reference, at the wheel
    transition_time: float = described(
        0.0, "Duration of every change of set-point [s]; 0: as fast as the limits allow.",
        minimum=0.0, maximum=MAX_TRANSITION_S,
    )  # fmt: skip
    stop_time: float = described(
        1.0, "Time after a zero set-point, or after the set-point's time-out, when the wheel is "
        "no longer driven [s].", minimum=0.05, maximum=MAX_STOP_TIME_S,
    )  # fmt: skip
    # The measurement is compared with the reference of this long ago; 0: with the present one.
    reference_delay: float = described(
        0.0, "Lag of the measured speed behind the reference, by delay and averaging [s].",
        minimum=0.0, maximum=10.0,
    )  # fmt: skip
    # The error is zero for every delay within this uncertainty that explains the measurement.
    reference_delay_uncertainty: float = described(
        0.0, "Uncertainty of that lag [s].", minimum=0.0, maximum=1.0
    )
    # Motor and voltage that changes of set-point keep to, in wheel rad/s; see
    # :class:`~smp_motor_control.reference.profile.Profile`
    drive: Drive | None = optional(Drive, "top_speed", prefix="drive.")
    speed_source: str = described(
        "measured", f"Speed source: {', '.join(SPEED_SOURCES[:2])} or observer."
    )
    difference_window: int = described(
        4, "Number of samples over which counts are differenced.", minimum=1, maximum=1000
    )
    # For the observer and for the jerk in the feed-forward
    model: MotorModel | None = optional(MotorModel, "dc_gain", "time_constant", prefix="model.")
    noise: ObserverNoise = nested(ObserverNoise(), prefix="observer.")
    implausible_jump: float = described(
        0.0, "Feedback that jumps for one sample by this, beyond the reach of the motor, is "
        "left out [rad/s, wheel]; 0: half of the top speed, and a count.", minimum=0.0
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_limits(self)
        if self.speed_source not in SPEED_SOURCES:
            known = ", ".join(SPEED_SOURCES)
            raise ParameterError(f"speed_source is {self.speed_source!r}; known are {known}")
        if self.speed_source == "observer" and self.model is None:
            raise ParameterError(
                "speed_source is 'observer', which needs model.dc_gain and model.time_constant"
            )

    def clamp_to_supply(self, supply_voltage: float) -> "LoopSettings":
        """Return the same settings with the output limited to the supply."""
        gains = replace(
            self.gains,
            u_clamp_min=max(self.gains.u_clamp_min, -supply_voltage),
            u_clamp_max=min(self.gains.u_clamp_max, supply_voltage),
        )
        return replace(self, gains=gains)


class WheelLoop:
    """Speed loop of one wheel, one step per feedback sample.

    ``reference`` and ``source`` (of the speed) are those of the last step; ``jumps`` is the number
    of ignored readings.
    """

    def __init__(
        self,
        settings: LoopSettings,
        gearbox: Gearbox | None = None,
        encoder: Encoder | None = None,
        max_load: float = math.inf,
    ) -> None:
        self.settings = settings
        self.pid = Pid(settings.gains)
        self.profile = Profile(settings.limits, settings.transition_time, settings.drive)
        self.reference = Reference(0.0, 0.0, 0.0)
        self._path = ReferencePath(self.profile)
        self.source, self.jumps = "measured", 0
        self._extra_lag = 0.0  # of differenced counts while the observer is not trusted [s]
        self._standstill = Standstill()
        self._plausible = PlausibleSpeed()
        self.configure(settings)
        self.set_hardware(gearbox, encoder, max_load)

    def set_hardware(
        self, gearbox: Gearbox | None, encoder: Encoder | None, max_load: float = math.inf
    ) -> None:
        """Set the hardware between motor and wheel."""
        self._gearbox, self._encoder, self._max_load = gearbox, encoder, max_load
        self._width = CounterWidth()
        self.wraps_at = 0  # detected width that differs from encoder.bits
        self.rebuild_speed_source()

    def configure(self, settings: LoopSettings) -> None:
        """Change settings without a jump of the output."""
        old, self.settings = self.settings, settings
        shaped = ("speed_source", "difference_window", "model", "noise")
        if any(getattr(old, name) != getattr(settings, name) for name in shaped):
            self.rebuild_speed_source()
        self.pid.set_gains(self._gains())
        self.profile.configure(settings.limits, settings.transition_time, settings.drive)
        self._plausible.configure(
            settings.gains, settings.drive, settings.implausible_jump, settings.reference_delay
        )
        if bool(old.reference_delay) != bool(settings.reference_delay):
            self._path.start(self.reference.velocity)  # the history is outdated

    def rebuild_speed_source(self) -> None:
        """Create the speed source from the settings."""
        if self._extra_lag:
            self._switch_gains(True)
        self._observer: SpeedObserver | None = None
        self._differenced: DifferencedSpeed | None = None
        self._count: int | None = None  # of the last sample
        self._intervals: list[float] = []
        self._time = 0.0
        self._speed_of: Callable[[float, float, int, float], float] = self._measured
        if self.settings.speed_source == "measured" or None in (self._gearbox, self._encoder):
            return
        assert self._encoder is not None
        self._differenced = DifferencedSpeed(self._encoder, self.settings.difference_window)
        self._speed_of = self._difference
        if self.settings.speed_source == "observer":
            self._speed_of = self._difference_and_learn

    def reset_speed(self) -> None:
        """Discard past samples, as after lost feedback."""
        self._plausible.reset()
        self._restart()

    def _restart(self) -> None:
        if self._differenced is not None:
            self._differenced.reset()
        if self._observer is not None:
            self._observer.reset()

    def speed(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        """Return the wheel's speed after one more sample; NaN if unknown or implausible."""
        bits = self._width.step(count)
        if bits and self._encoder is not None and self._encoder.bits != bits:
            self.wraps_at = bits
            self._encoder = replace(self._encoder, bits=bits)
            self.rebuild_speed_source()
        speed = self._speed_of(dt, velocity, count, voltage)
        if speed != speed:
            return speed
        resolution = self._one_count(dt)
        if self._plausible.accepts(speed, dt, voltage, resolution, self.profile.target):
            return speed
        self.jumps += 1
        self._restart()
        return math.nan

    def _one_count(self, dt: float) -> float:
        """Return the change of the differenced speed by one count [rad/s]."""
        if self._count is None or self._gearbox is None or self._encoder is None or not dt > 0.0:
            return 0.0
        window = 1 if self._differenced is None else self.settings.difference_window
        return self._gearbox.to_wheel(self._encoder.angle_per_count) / (window * dt)

    def _measured(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        self.source = "measured"
        self._count = count or None  # 0: hardware without an encoder
        return velocity

    def _difference(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        assert self._differenced is not None and self._gearbox is not None
        self.source = "difference"
        self._count = count
        self._time += dt
        return self._gearbox.to_wheel(self._differenced.step(self._time, count))

    def _difference_and_learn(
        self, dt: float, velocity: float, count: int, voltage: float
    ) -> float:
        """Difference counts until the sampling interval is known, then start the observer."""
        self._intervals.append(dt)
        if len(self._intervals) >= INTERVAL_SAMPLES:
            usual = sorted(self._intervals)[len(self._intervals) // 2]
            settings = self.settings
            assert settings.model is not None and self._encoder is not None
            self._observer = SpeedObserver(
                settings.model,
                usual,
                self._encoder,
                settings.noise,
                settings.difference_window,
                self._max_load,
            )
            self._intervals = []
            self._speed_of = self._observe
        return self._difference(dt, velocity, count, voltage)

    def _observe(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        observer = self._observer
        assert observer is not None and self._gearbox is not None
        self._count = count
        speed = observer.step(count, voltage, dt)
        trusted = observer.trusted
        self.source = "observer" if trusted else "difference (observer not trusted)"
        if trusted == (self._extra_lag > 0.0):
            self._switch_gains(trusted, dt)
        return self._gearbox.to_wheel(speed)

    def _switch_gains(self, observer: bool, dt: float = 0.0) -> None:
        """Switch between the gains for the observer and those for differenced counts.

        The integral of a saturated command is not kept.
        """
        self._extra_lag = 0.0 if observer else 0.5 * self.settings.difference_window * dt
        self.pid.reset(save_i_term=observer or not self.pid.saturated)
        self.pid.set_gains(self._gains())

    def _gains(self) -> PidGains:
        """Return the gains for the present speed source."""
        settings = self.settings
        if not self._extra_lag:
            return settings.gains
        assert settings.model is not None and self._gearbox is not None
        return differenced_gains(
            settings.gains,
            settings.model,
            self._gearbox.ratio,
            self._extra_lag,
            settings.difference_window,
        )

    def start(self, measurement: float) -> None:
        """Close the loop without a jump on a wheel that turns at ``measurement``."""
        self.pid.reset()
        self._path.start(measurement)
        self._standstill = Standstill()

    def halt(self) -> None:
        """Set the reference to zero at once."""
        self._path.start(0.0)
        self.reference = self.profile.now

    def step(self, setpoint: float, measurement: float, dt: float) -> PidOutput:
        """Advance reference and controller by one sample; hold a standing wheel."""
        count = self._count
        if count is None or setpoint != 0.0:
            self._standstill.reset()
            return self._follow(setpoint, measurement, dt)
        held = self._standstill.voltage(count, dt)
        if held is not None:
            self.pid.reset()
            self.pid.i_term = held  # start value when the wheel moves
            return PidOutput(held, held, 0.0, held, 0.0, 0.0, False)
        out = self._follow(setpoint, measurement, dt)
        if self.reference.velocity == 0.0:
            self._standstill.step(count, out.output, dt)
        return out

    def _follow(self, setpoint: float, measurement: float, dt: float) -> PidOutput:
        settings, profile = self.settings, self.profile
        if settings.reference_delay:
            path = self._path
            now = path.step(setpoint, dt)
            delay = settings.reference_delay + self._extra_lag
            uncertainty = settings.reference_delay_uncertainty
            nominal, compared = path.delayed(delay, uncertainty, measurement)
            acceleration_feedforward = path.acceleration_feedforward(
                compared, settings.gains, settings.model
            )
            self.reference = now._replace(velocity=nominal)
            return self.pid.step(compared, measurement, dt, acceleration_feedforward)
        if setpoint != profile.target:
            profile.set_target(setpoint, dt)
        self.reference = reference = profile.step(dt)
        return self.pid.step(reference.velocity, measurement, dt, reference.acceleration)
