"""One wheel's speed loop without ROS: speed source, reference, PID.

Set-point and speeds are the wheel's; counts and the model are the motor's.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from smp_motor_control.encoder import CounterWidth, DifferencedSpeed, Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.fields import check_limits, described, nested, optional
from smp_motor_control.motor.model import MotorModel
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_control.observer import ObserverNoise, SpeedObserver
from smp_motor_control.pid import Pid, PidGains, PidOutput
from smp_motor_control.reference.path import ReferencePath
from smp_motor_control.reference.profile import Drive, Profile, ProfileLimits, Reference
from smp_motor_control.wheel.differenced import differenced_gains
from smp_motor_control.wheel.plausibility import PlausibleSpeed
from smp_motor_control.wheel.standstill import Standstill
from smp_motor_control.wheel.stop import LONGEST_STOP

SPEED_SOURCES = ("measured", "difference", "observer")

LONGEST_TRANSITION = 60.0
"""Largest duration of a change of set-point [s]."""

LEARNING = 20
"""Samples from which the observer learns the usual interval."""


@dataclass(frozen=True, kw_only=True)
class LoopSettings:
    """Everything that shapes the loop."""

    gains: PidGains = nested(PidGains())  # volts of wheel speeds
    limits: ProfileLimits = nested(ProfileLimits())  # of the reference, at the wheel
    transition_time: float = described(
        0.0, "Duration of every change of set-point [s]; 0: as fast as limits allow.",
        minimum=0.0, maximum=LONGEST_TRANSITION,
    )  # fmt: skip
    stop_time: float = described(
        1.0, "Time after a set-point of zero, or after the last one's time-out, at which nothing "
        "drives the wheel any more [s].", minimum=0.05, maximum=LONGEST_STOP,
    )  # fmt: skip
    # The error is taken from the reference of that long ago, so that a wheel that does what its
    # model says is left alone; 0: from the present one.
    reference_delay: float = described(
        0.0, "Lag of the measured speed behind the reference: delay and averaging [s].",
        minimum=0.0, maximum=10.0,
    )  # fmt: skip
    # There is no error while the measurement is what the reference was within so much of the delay.
    reference_doubt: float = described(
        0.0, "Uncertainty of that lag [s].", minimum=0.0, maximum=1.0
    )
    # Motor and voltage that changes of set-point keep to, in wheel rad/s; see
    # :class:`~smp_motor_control.reference.profile.Profile`
    drive: Drive | None = optional(Drive, "top_speed", prefix="drive.")
    speed_source: str = described("measured", f"{', '.join(SPEED_SOURCES[:2])} or observer.")
    difference_window: int = described(
        4, "Samples to difference counts over.", minimum=1, maximum=1000
    )
    # Of the motor, for the observer, and for the jerk in the feed-forward
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

    def within(self, supply_voltage: float) -> "LoopSettings":
        """Return the same with the output limited to what a supply can give."""
        gains = replace(
            self.gains,
            u_clamp_min=max(self.gains.u_clamp_min, -supply_voltage),
            u_clamp_max=min(self.gains.u_clamp_max, supply_voltage),
        )
        return replace(self, gains=gains)


class WheelLoop:
    """Speed loop of one wheel, one step per feedback sample.

    ``reference`` and ``source`` (of the speed) are those of the last step, ``jumps`` how many
    readings of the speed were left out.
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
        self._late = 0.0  # by which counts differenced in the observer's place are later [s]
        self._standstill = Standstill()
        self._plausible = PlausibleSpeed()
        self.configure(settings)
        self.set_hardware(gearbox, encoder, max_load)

    def set_hardware(
        self, gearbox: Gearbox | None, encoder: Encoder | None, max_load: float = math.inf
    ) -> None:
        """Tell what is between motor and wheel."""
        self._gearbox, self._encoder, self._max_load = gearbox, encoder, max_load
        self._width, self.wraps_at = CounterWidth(), 0  # bits at which it does, against its word
        self.renew_speed()

    def configure(self, settings: LoopSettings) -> None:
        """Change settings while running, without a jump of the output."""
        old, self.settings = self.settings, settings
        shaped = ("speed_source", "difference_window", "model", "noise")
        if any(getattr(old, name) != getattr(settings, name) for name in shaped):
            self.renew_speed()
        self.pid.set_gains(self._gains())
        self.profile.configure(settings.limits, settings.transition_time, settings.drive)
        self._plausible.configure(
            settings.gains, settings.drive, settings.implausible_jump, settings.reference_delay
        )
        if bool(old.reference_delay) != bool(settings.reference_delay):
            self._path.start(self.reference.velocity)  # its past is older than that

    def renew_speed(self) -> None:
        """Make the speed's source anew from the settings."""
        if self._late:
            self._trust(True)
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
            self._speed_of = self._learn

    def reset_speed(self) -> None:
        """Forget past samples, as after lost feedback."""
        self._plausible.reset()
        self._restart()

    def _restart(self) -> None:
        if self._differenced is not None:
            self._differenced.reset()
        if self._observer is not None:
            self._observer.reset()

    def speed(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        """Return the wheel's speed after one more sample, NaN where it is not known or jumps."""
        bits = self._width.step(count)
        if bits and self._encoder is not None and self._encoder.bits != bits:
            self.wraps_at = bits
            self._encoder = replace(self._encoder, bits=bits)
            self.renew_speed()
        speed = self._speed_of(dt, velocity, count, voltage)
        if speed != speed:
            return speed
        resolution = self._one_count(dt)
        # Counts that jump beyond what is plausible are left out without knowing the motor.
        asked = self.profile.target if self.source == "measured" else math.inf
        if self._plausible.accepts(speed, dt, voltage, resolution, asked):
            return speed
        self.jumps += 1
        self._restart()
        return math.nan

    def _one_count(self, dt: float) -> float:
        """Return what one count more adds to a speed that is differenced from counts [rad/s]."""
        if self._count is None or self._gearbox is None or self._encoder is None or not dt > 0.0:
            return 0.0
        over = 1 if self._differenced is None else self.settings.difference_window
        return self._gearbox.to_wheel(self._encoder.angle_per_count) / (over * dt)

    def _measured(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        self.source = "measured"
        self._count = count or None  # 0: of hardware without counts
        return velocity

    def _difference(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        assert self._differenced is not None and self._gearbox is not None
        self.source = "difference"
        self._count = count
        self._time += dt
        return self._gearbox.to_wheel(self._differenced.step(self._time, count))

    def _learn(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        """Difference until the usual interval is known, then start the observer."""
        self._intervals.append(dt)
        if len(self._intervals) >= LEARNING:
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
        if trusted == (self._late > 0.0):
            self._trust(trusted, dt)
        return self._gearbox.to_wheel(speed)

    def _trust(self, observer: bool, dt: float = 0.0) -> None:
        """Go on with the gains for the observer, or those for counts differenced in its place.

        The integral of a command beyond its clamps is no load's, and is not kept.
        """
        self._late = 0.0 if observer else 0.5 * self.settings.difference_window * dt
        self.pid.reset(save_i_term=observer or not self.pid.saturated)
        self.pid.set_gains(self._gains())

    def _gains(self) -> PidGains:
        """Return the gains for the speed that there is."""
        settings = self.settings
        if not self._late:
            return settings.gains
        assert settings.model is not None and self._gearbox is not None
        return differenced_gains(
            settings.gains,
            settings.model,
            self._gearbox.ratio,
            self._late,
            settings.difference_window,
        )

    def start(self, measurement: float) -> None:
        """Close the loop on a wheel that turns at ``measurement``, without a jump."""
        self.pid.reset()
        self._path.start(measurement)
        self._standstill = Standstill()

    def halt(self) -> None:
        """Ask for a standstill at once, wherever the reference is on its way there."""
        self._path.start(0.0)
        self.reference = self.profile.now

    def step(self, setpoint: float, measurement: float, dt: float) -> PidOutput:
        """Advance reference and controller by one sample; a wheel that stands is left alone."""
        count = self._count
        if count is None or setpoint != 0.0:
            self._standstill.reset()
            return self._follow(setpoint, measurement, dt)
        held = self._standstill.voltage(count, dt)
        if held is not None:
            self.pid.reset()
            self.pid.i_term = held  # with which it goes on when the wheel moves
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
            delay, doubt = settings.reference_delay + self._late, settings.reference_doubt
            nominal, compared = path.ago(delay, doubt, measurement)
            forward = path.forward(compared, settings.gains, settings.model)
            self.reference = now._replace(velocity=nominal)
            return self.pid.step(compared, measurement, dt, forward)
        if setpoint != profile.target:
            profile.set_target(setpoint, dt)
        self.reference = reference = profile.step(dt)
        return self.pid.step(reference.velocity, measurement, dt, reference.acceleration)
