"""One wheel's speed loop without ROS: speed source, reference, PID.

Set-point and speeds are the wheel's; counts and the model are the motor's.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from smp_motor_control.encoder import DifferencedSpeed, Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor import Gearbox
from smp_motor_control.motor_model import MotorModel
from smp_motor_control.observer import ObserverNoise, SpeedObserver
from smp_motor_control.pid import Pid, PidGains, PidOutput
from smp_motor_control.profile import Profile, ProfileLimits, Reference

SPEED_SOURCES = ("measured", "difference", "observer")

_LEARNING = 20
"""Samples from which the observer learns the usual interval."""

_HALF_WAY = math.log(2.0)
"""Time constants after which a first-order lag has gone half of its way."""


@dataclass(frozen=True, kw_only=True)
class LoopSettings:
    """Everything that shapes the loop.

    Attributes
    ----------
    gains : PidGains
        Volts of wheel speeds.
    limits : ProfileLimits
        Of the reference, at the wheel.
    transition_time : float
        Duration of every change of set-point [s]; 0: as fast as the limits allow.
    speed_source : {'measured', 'difference', 'observer'}
        What is fed back: the speed that the hardware reports, counts differenced, or the
        observer's.
    difference_window : int
        Samples to difference over.
    model : MotorModel or None
        Of the motor, for the observer, and for the jerk in the feed-forward.
    noise : ObserverNoise
        What the observer expects.
    reference_delay : float
        How much later than the feed-forward acts the measured speed can show it [s]: delay,
        hold and averaging of the loop.  The error is taken from the reference of that long
        ago, so that a wheel that does what its model says is left alone; 0: from the present
        one.

    Raises
    ------
    ParameterError
        When a value is out of range, or the observer lacks its model.
    """

    gains: PidGains = field(default_factory=PidGains)
    limits: ProfileLimits = field(default_factory=ProfileLimits)
    transition_time: float = 0.0
    speed_source: str = "measured"
    difference_window: int = 4
    model: MotorModel | None = None
    noise: ObserverNoise = field(default_factory=ObserverNoise)
    reference_delay: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.reference_delay < math.inf:
            raise ParameterError(
                f"reference_delay is {self.reference_delay!r} s; it must be zero or positive"
            )
        if not 0.0 <= self.transition_time < math.inf:
            raise ParameterError(
                f"transition_time is {self.transition_time!r} s; it must be zero or positive"
            )
        if self.speed_source not in SPEED_SOURCES:
            known = ", ".join(SPEED_SOURCES)
            raise ParameterError(f"speed_source is {self.speed_source!r}; known are {known}")
        if self.difference_window < 1:
            raise ParameterError(
                f"difference_window is {self.difference_window!r}; it must be at least 1"
            )
        if self.speed_source == "observer" and self.model is None:
            raise ParameterError(
                "speed_source is 'observer', which needs model.dc_gain and model.time_constant"
            )

    def within(self, supply_voltage: float) -> LoopSettings:
        """Return the same with the output limited to what a supply can give.

        Parameters
        ----------
        supply_voltage : float
            [V]; infinite where unknown.

        Returns
        -------
        LoopSettings
            With both output clamps within the supply.

        Raises
        ------
        ParameterError
            When a clamp leaves nothing within the supply.
        """
        gains = replace(
            self.gains,
            u_clamp_min=max(self.gains.u_clamp_min, -supply_voltage),
            u_clamp_max=min(self.gains.u_clamp_max, supply_voltage),
        )
        return replace(self, gains=gains)


class WheelLoop:
    """Speed loop of one wheel, one step per feedback sample.

    Parameters
    ----------
    settings : LoopSettings
        Changed later with :meth:`configure`.
    gearbox, encoder : Gearbox, Encoder, optional
        Of the wheel; without, only the reported speed can be fed back.
    max_load : float
        Loads beyond this voltage contradict the observer's model [V].

    Attributes
    ----------
    pid : Pid
        The controller.
    profile : Profile
        Source of the reference.
    reference : Reference
        Of the last step.
    source : str
        Where the speed came from in the last step.
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
        self.profile = Profile(settings.limits, settings.transition_time)
        self.reference = Reference(0.0, 0.0, 0.0)
        self._elapsed = 0.0
        self._past: deque[tuple[float, float]] = deque([(0.0, 0.0)])
        self.source = "measured"
        self.set_hardware(gearbox, encoder, max_load)

    def set_hardware(
        self, gearbox: Gearbox | None, encoder: Encoder | None, max_load: float = math.inf
    ) -> None:
        """Tell what is between motor and wheel.

        Parameters
        ----------
        gearbox : Gearbox or None
            None where unknown.
        encoder : Encoder or None
            None where unknown.
        max_load : float
            [V], see the class.
        """
        self._gearbox, self._encoder, self._max_load = gearbox, encoder, max_load
        self._renew_speed()

    def configure(self, settings: LoopSettings) -> None:
        """Change settings while running, without a jump of the output.

        Parameters
        ----------
        settings : LoopSettings
            Valid by construction.
        """
        old, self.settings = self.settings, settings
        self.pid.set_gains(settings.gains)
        self.profile.configure(settings.limits, settings.transition_time)
        shaped = ("speed_source", "difference_window", "model", "noise")
        if any(getattr(old, name) != getattr(settings, name) for name in shaped):
            self._renew_speed()

    def _renew_speed(self) -> None:
        self._observer: SpeedObserver | None = None
        self._differenced: DifferencedSpeed | None = None
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
        if self._differenced is not None:
            self._differenced.reset()
        if self._observer is not None:
            self._observer.reset()

    def speed(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        """Return the wheel's speed after one more sample.

        Parameters
        ----------
        dt : float
            Interval that ends with it [s], positive.
        velocity : float
            As the hardware reports it [rad/s, wheel].
        count : int
            As the counter shows it [counts, motor].
        voltage : float
            Mean over the interval [V].

        Returns
        -------
        float
            [rad/s, wheel]; NaN while the source has too few samples.
        """
        return self._speed_of(dt, velocity, count, voltage)

    def _measured(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        self.source = "measured"
        return velocity

    def _difference(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        assert self._differenced is not None and self._gearbox is not None
        self.source = "difference"
        self._time += dt
        return self._gearbox.to_wheel(self._differenced.step(self._time, count))

    def _learn(self, dt: float, velocity: float, count: int, voltage: float) -> float:
        """Difference until the usual interval is known, then start the observer."""
        self._intervals.append(dt)
        if len(self._intervals) >= _LEARNING:
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
        speed = observer.step(count, voltage, dt)
        self.source = "observer" if observer.trusted else "difference (observer not trusted)"
        return self._gearbox.to_wheel(speed)

    def start(self, measurement: float) -> None:
        """Close the loop on a wheel that turns at ``measurement``, without a jump.

        Parameters
        ----------
        measurement : float
            [rad/s, wheel].
        """
        self.pid.reset()
        self.profile.reset(measurement)
        self._past = deque([(self._elapsed, measurement)])

    def step(self, setpoint: float, measurement: float, dt: float) -> PidOutput:
        """Advance reference and controller by one sample.

        Parameters
        ----------
        setpoint, measurement : float
            [rad/s, wheel].
        dt : float
            [s], positive.

        Returns
        -------
        PidOutput
            Volts and their parts.
        """
        profile = self.profile
        if setpoint != profile.target:
            profile.set_target(setpoint)
        self.reference = reference = profile.step(dt)
        if self.settings.reference_delay:
            return self._step_behind(reference, measurement, dt)
        return self.pid.step(reference.velocity, measurement, dt, reference.acceleration)

    def _step_behind(self, ahead: Reference, measurement: float, dt: float) -> PidOutput:
        """Feed forward from the reference, compare with the one of some time ago.

        The controller adds ``fv r_d + fa x`` for the delayed reference ``r_d``; with the x below
        that is ``fv r + fa (r' + r'' a2 / a1)``, what the model needs for the present one.
        """
        settings = self.settings
        gains, model = settings.gains, settings.model
        delayed = self._reference_ago(settings.reference_delay, ahead.velocity, dt)
        forward = ahead.acceleration
        if gains.feedforward_acceleration:
            share = gains.feedforward_velocity / gains.feedforward_acceleration
            forward += share * (ahead.velocity - delayed)
            if model is not None:
                electrical = model.time_constant_product / model.time_constant
                forward += ahead.jerk * electrical
                if self._friction_turns(ahead, delayed, electrical):
                    turn = math.copysign(2 * gains.feedforward_static, self.profile.target)
                    forward += turn / gains.feedforward_acceleration
        self.reference = ahead._replace(velocity=delayed)
        return self.pid.step(delayed, measurement, dt, forward)

    def _friction_turns(self, ahead: Reference, delayed: float, electrical: float) -> bool:
        """Return whether, on the way through zero, the friction's voltage has to turn by now.

        The wheel passes zero when the reference ahead does, later than the delayed one.  The
        current follows a turn of the voltage with the electrical time constant: half of it is
        there after ln 2 of that, so the voltage turns so much earlier.
        """
        target = self.profile.target
        if delayed * target >= 0.0:
            return False
        soon = ahead.velocity + _HALF_WAY * electrical * ahead.acceleration
        return soon * target > 0.0

    def _reference_ago(self, delay: float, velocity: float, dt: float) -> float:
        """Return the reference's velocity ``delay`` before now, between samples linearly."""
        self._elapsed += dt
        past = self._past
        past.append((self._elapsed, velocity))
        then = self._elapsed - delay
        while len(past) > 2 and past[1][0] <= then:
            past.popleft()
        (t0, v0), (t1, v1) = past[0], past[1]
        return v0 + (v1 - v0) * min(max((then - t0) / (t1 - t0), 0.0), 1.0)
