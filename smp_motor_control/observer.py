"""Motor speed from encoder counts and voltage by a steady-state Kalman filter.

State ``(theta, w, w', d)`` of the identified motor (see :mod:`~smp_motor_control.motor.model`)
with the load ``d`` as a random walk, so that the speed has no bias under any constant load:

    theta' = w,   tp w'' + tau w' + w = K (v - friction - d + n_v),   d' = n_d,
    counts = theta / q + quantisation, uniform, variance 1/12.

Each step predicts exactly over its own dt (voltage held constant) and corrects with the
steady-state gain for that dt.  Where the counts contradict the model, by the mean of the
normalised innovation squared, the speed falls back to differenced counts until they agree.

References
----------
R. F. Stengel, *Optimal Control and Estimation*, Dover 1994, sections 4.3 and 4.5;
Y. Bar-Shalom, X.-R. Li and T. Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, Wiley 2001, section 5.4 for the innovation test.
"""

from __future__ import annotations

import math
from collections import deque

from smp_motor_control.encoder import DifferencedSpeed, Encoder, Unwrapper
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.model import MotorModel
from smp_motor_control.observer_gain import ObserverNoise, steady_gain

__all__ = ["ObserverNoise", "SpeedObserver"]

_STEPS_PER_OCTAVE = 2
_OCTAVES = 2
_AGREE, _DISAGREE = 3.0, 9.0
_INNOVATION_MEMORY = 0.05


class SpeedObserver:
    """Speed, acceleration and load of one motor.

    Parameters
    ----------
    model : MotorModel
        The identified motor.
    sample_time : float
        Usual interval between samples [s]; steps from a quarter to four times as long are filtered.
    encoder : Encoder
        Counts per revolution of the motor shaft, and width of the counter.
    noise : ObserverNoise
        What to expect of load, voltage and encoder.
    window : int
        Samples that the speed is differenced over while the model is not trusted.
    max_load : float
        Loads beyond this voltage contradict the model; such as 1.5 times the supply [V].

    Attributes
    ----------
    speed : float
        Of the motor shaft [rad/s]; NaN before the second sample.
    acceleration : float
        [rad/s^2].
    load : float
        Voltage that the load takes beyond the model, positive against forward turning [V].
    trusted : bool
        Whether counts and model agree; the speed is differenced while they do not.

    Raises
    ------
    ParameterError
        When ``sample_time``, ``window`` or ``max_load`` is not positive.
    """

    def __init__(
        self,
        model: MotorModel,
        sample_time: float,
        encoder: Encoder,
        noise: ObserverNoise | None = None,
        window: int = 4,
        max_load: float = math.inf,
    ) -> None:
        if not 0.0 < sample_time < math.inf:
            raise ParameterError(f"sample_time of the observer is {sample_time} s: not positive")
        if not max_load > 0.0:
            raise ParameterError(f"max_load of the observer is {max_load} V: must be positive")
        self._model, self._max_load = model, max_load
        self._quantum = encoder.angle_per_count
        self._unwrap = Unwrapper(encoder.bits)
        self._differenced = DifferencedSpeed(Encoder(encoder.counts_per_revolution), window)
        self._shortest = sample_time / 2**_OCTAVES
        self._longest = sample_time * 2**_OCTAVES
        noise = noise or ObserverNoise()
        self._gains = [
            steady_gain(model, self._quantum, noise, self._shortest * 2 ** (k / _STEPS_PER_OCTAVE))
            for k in range(2 * _OCTAVES * _STEPS_PER_OCTAVE + 1)
        ]
        # Below this speed the motor may stick: less than a count in the shortest memory.
        self._slow = self._quantum / max(8.0 * sample_time, 0.02)
        self._dt = 0.0
        self._prepare(sample_time)
        self.reset()

    def reset(self) -> None:
        """Forget everything, as after lost feedback."""
        self._unwrap.reset()
        self._differenced.reset()
        self._known = False
        self._time = 0.0
        self._voltages: deque[tuple[float, float]] = deque()
        self._theta = self._speed = self.acceleration = self.load = 0.0
        self._surprise = 1.0
        self.trusted = True
        self.speed = math.nan

    def step(self, count: int, voltage: float, dt: float) -> float:
        """Take in one sample.

        Parameters
        ----------
        count : int
            As the hardware reports it.
        voltage : float
            Mean armature voltage over the interval that ends with the sample [V].
        dt : float
            Length of that interval [s], positive.

        Returns
        -------
        float
            Speed of the motor shaft [rad/s]; NaN at the first sample.

        Raises
        ------
        ParameterError
            When voltage or dt is not finite, or dt not positive; nothing has changed.
        """
        if not 0.0 < dt < math.inf or voltage - voltage != 0.0:
            raise ParameterError(f"observer got {voltage} V over {dt} s: must be finite, dt > 0")
        total = self._unwrap(count)
        self._time += dt
        differenced = self._differenced.step(self._time, total)
        angle = total * self._quantum
        if not self._known or dt > self._longest:
            self._restart(angle, differenced)
            return self.speed
        if dt != self._dt:
            self._prepare(dt)
        self._predict(self._delayed(voltage, dt) if self._model.delay else voltage, dt)
        g_theta, g_speed, g_acceleration, g_load, variance = self._gain
        innovation = angle - self._theta
        self._theta += g_theta * innovation
        self._speed += g_speed * innovation
        self.acceleration += g_acceleration * innovation
        self.load += g_load * innovation
        self._surprise += self._memory * (innovation * innovation / variance - self._surprise)
        if self._surprise > _DISAGREE or abs(self.load) > self._max_load:
            if self.trusted:
                self._restart(angle, differenced)
            self.trusted = False
        elif self._surprise < _AGREE:
            self.trusted = True
        self.speed = self._speed if self.trusted else differenced
        return self.speed

    def _restart(self, angle: float, speed: float) -> None:
        """Begin again at a measured angle and speed, with the load as last known."""
        self._known = True
        self._theta = angle
        self._speed = speed if speed == speed else 0.0
        self.acceleration = 0.0
        self.load = min(max(self.load, -self._max_load), self._max_load)
        self.speed = speed

    def _prepare(self, dt: float) -> None:
        """Compute what a step of this length needs; kept while the length stays the same."""
        model, tp = self._model, self._model.time_constant_product
        self._dt = dt
        place = math.log2(max(dt / self._shortest, 1.0)) * _STEPS_PER_OCTAVE
        self._gain = self._gains[min(round(place), len(self._gains) - 1)]
        self._memory = min(dt / _INNOVATION_MEMORY, 1.0)
        if tp == 0.0:
            self._c = self._s = math.exp(-dt / model.time_constant)
            return
        sigma = model.time_constant / (2.0 * tp)
        square = sigma * sigma - 1.0 / tp
        root = math.sqrt(abs(square))
        decay = math.exp(-sigma * dt)
        if root * dt < 1e-6:
            cos, sin = decay, decay * dt
        elif square > 0.0:
            grown, shrunk = math.exp((root - sigma) * dt), math.exp(-(root + sigma) * dt)
            cos, sin = (grown + shrunk) / 2.0, (grown - shrunk) / (2.0 * root)
        else:
            cos, sin = decay * math.cos(root * dt), decay * math.sin(root * dt) / root
        self._c, self._s, self._sigma = cos, sin, sigma

    def _predict(self, voltage: float, dt: float) -> None:
        """Advance the state by the exact response to a constant voltage."""
        model, speed, acceleration = self._model, self._speed, self.acceleration
        drive = voltage - self.load
        static = model.static_voltage
        if static:
            if -self._slow < speed < self._slow:
                drive -= min(max(drive, -static), static)
            else:
                drive -= static if speed > 0.0 else -static
        final = model.dc_gain * drive
        off = speed - final
        tau, tp = model.time_constant, model.time_constant_product
        if tp:
            c, s, bend = self._c, self._s, self._sigma * self._s
            new_off = off * (c + bend) + acceleration * s
            new_acceleration = acceleration * (c - bend) - off * s / tp
        else:
            new_off = off * self._c
            new_acceleration = -new_off / tau
            tp = 0.0
        # The integral of the equation of motion gives the angle.
        self._theta += final * dt + tp * (acceleration - new_acceleration) + tau * (off - new_off)
        self._speed = final + new_off
        self.acceleration = new_acceleration

    def _delayed(self, voltage: float, dt: float) -> float:
        """Return the mean voltage that acted during the step, ``delay`` after it was applied."""
        past = self._voltages
        now = self._time
        past.append((now, voltage))
        begin, end = now - dt - self._model.delay, now - self._model.delay
        while len(past) > 1 and past[0][0] <= begin:
            past.popleft()
        volt_seconds, since = 0.0, begin
        for until, held in past:
            upto = min(until, end)
            if upto > since:
                volt_seconds += held * (upto - since)
                since = upto
        return volt_seconds / dt
