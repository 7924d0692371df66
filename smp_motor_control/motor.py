"""The DC motor with Coulomb friction, integrated exactly over intervals of constant voltage.

Between two switchings of the friction the motor is linear,

    L di/dt     = v - R i - K omega
    J domega/dt = K i - b omega - Tc sign(omega) - Tl,

so its response to a constant voltage is known in closed form.  The instants at which the
rotor stops, sticks, reverses or breaks loose are located inside the step, so the only error
of a step is rounding, whatever its length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.errors import ParameterError

_UNITS = {
    "resistance": "ohm",
    "inductance": "H",
    "motor_constant": "N m/A",
    "inertia": "kg m^2",
    "viscous_friction": "N m s/rad",
    "coulomb_friction": "N m",
}
_MAY_BE_ZERO = ("inductance", "viscous_friction", "coulomb_friction")
Motion = TypeVar("Motion", float, NDArray[np.float64])
_MAX_CACHED_STEPS = 64
_MAX_EVENTS_PER_STEP = 100_000


@dataclass(frozen=True, kw_only=True)
class MotorParameters:
    """Physical parameters of a brushed DC motor at its own shaft.

    Attributes
    ----------
    resistance : float
        Armature resistance R [ohm], positive.
    inductance : float
        Armature inductance L [H]; 0 leaves the first-order motor.
    motor_constant : float
        Torque constant = back-EMF constant K [N m/A = V s/rad], positive.
    inertia : float
        Inertia J of everything that turns [kg m^2], positive.
    viscous_friction : float
        b [N m s/rad].
    coulomb_friction : float
        Tc [N m]; also the largest torque at which the rotor sticks.

    Raises
    ------
    ParameterError
        When a value is not a finite number or has a sign that no motor can have.
    """

    resistance: float
    inductance: float
    motor_constant: float
    inertia: float
    viscous_friction: float
    coulomb_friction: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise ParameterError(f"{item.name} is {value!r}; it must be a number")
            zero_allowed = item.name in _MAY_BE_ZERO
            if not math.isfinite(value) or value < 0 or (value == 0 and not zero_allowed):
                wanted = "zero or positive" if zero_allowed else "positive"
                unit = _UNITS[item.name]
                raise ParameterError(f"{item.name} is {value!r} {unit}; it must be {wanted}")
            object.__setattr__(self, item.name, float(value))

    @classmethod
    def from_combinations(
        cls,
        *,
        dc_gain: float,
        time_constant: float,
        time_constant_product: float = 0.0,
        static_voltage: float = 0.0,
        resistance: float = 1.0,
    ) -> MotorParameters:
        """Return a motor that answers a voltage like the one with these combinations.

        Voltage and speed do not tell the physical parameters apart; of all motors with the
        same response this takes the one without viscous friction: ``K = a0``,
        ``J = a1 K / R``, ``L = a2 R / a1``.  The response is the same while the motor
        slides; where friction switches, it is if the original has no viscous friction.

        Parameters
        ----------
        dc_gain : float
            ``1 / a0`` [rad/s/V].
        time_constant : float
            ``a1 / a0`` [s].
        time_constant_product : float
            ``a2 / a0`` [s^2]; 0 for a first-order motor.
        static_voltage : float
            ``R Tc / K`` [V], the voltage below which the motor sticks.
        resistance : float
            Free choice [ohm]; only currents depend on it.

        Returns
        -------
        MotorParameters
            A motor of the same response from voltage to speed.

        Raises
        ------
        ParameterError
            When a combination has a value that no motor has.
        """
        named = {"dc_gain": dc_gain, "time_constant": time_constant, "resistance": resistance}
        for name, value in named.items():
            if not (math.isfinite(value) and value > 0):
                raise ParameterError(f"{name} is {value!r}; it must be positive")
        named = {"time_constant_product": time_constant_product, "static_voltage": static_voltage}
        for name, value in named.items():
            if not (math.isfinite(value) and value >= 0):
                raise ParameterError(f"{name} is {value!r}; it must be zero or positive")
        motor_constant = 1.0 / dc_gain
        return cls(
            resistance=resistance,
            inductance=time_constant_product * resistance / time_constant,
            motor_constant=motor_constant,
            inertia=time_constant * motor_constant**2 / resistance,
            viscous_friction=0.0,
            coulomb_friction=static_voltage * motor_constant / resistance,
        )

    @property
    def a0(self) -> float:
        """Voltage per speed in steady state, ``(R b + K^2) / K`` [V s/rad]."""
        return (
            self.resistance * self.viscous_friction + self.motor_constant**2
        ) / self.motor_constant

    @property
    def a1(self) -> float:
        """``(R J + L b) / K`` [V s^2/rad]."""
        return (
            self.resistance * self.inertia + self.inductance * self.viscous_friction
        ) / self.motor_constant

    @property
    def a2(self) -> float:
        """``L J / K`` [V s^3/rad]."""
        return self.inductance * self.inertia / self.motor_constant

    @property
    def dc_gain(self) -> float:
        """Speed per volt in steady state, without Coulomb friction [rad/s/V]."""
        return 1.0 / self.a0

    @property
    def time_constant(self) -> float:
        """``a1 / a0`` [s], the sum of the two time constants."""
        return self.a1 / self.a0

    @property
    def time_constant_product(self) -> float:
        """``a2 / a0`` [s^2], the product of the two time constants."""
        return self.a2 / self.a0

    @property
    def static_voltage(self) -> float:
        """Voltage at which the unloaded motor breaks loose, ``R Tc / K`` [V]."""
        return self.resistance * self.coulomb_friction / self.motor_constant


@dataclass(frozen=True)
class Gearbox:
    """The one place that converts between motor shaft and wheel.

    Attributes
    ----------
    ratio : float
        Motor revolutions per wheel revolution; positive.

    Raises
    ------
    ParameterError
        When the ratio is not a positive finite number.

    Examples
    --------
    >>> Gearbox(65.5).to_motor(2.0)
    131.0
    """

    ratio: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.ratio) and self.ratio > 0):
            raise ParameterError(f"gear ratio is {self.ratio!r}; it must be positive")

    def to_motor(self, wheel: Motion) -> Motion:
        """Return the motor's angle [rad], speed [rad/s] or acceleration of a wheel's.

        Parameters
        ----------
        wheel : float or ndarray
            Angle, speed or acceleration of the wheel.

        Returns
        -------
        float or ndarray
            ``ratio`` times as much.
        """
        return wheel * self.ratio

    def to_wheel(self, motor: Motion) -> Motion:
        """Return the wheel's angle [rad], speed [rad/s] or acceleration of a motor's.

        Parameters
        ----------
        motor : float or ndarray
            Angle, speed or acceleration of the motor.

        Returns
        -------
        float or ndarray
            ``1 / ratio`` times as much.
        """
        return motor / self.ratio

    def torque_to_motor(self, wheel_torque: float) -> float:
        """Return the torque that a load on the wheel puts on the motor shaft (no losses).

        Parameters
        ----------
        wheel_torque : float
            [N m] at the wheel.

        Returns
        -------
        float
            [N m] at the motor shaft, ``1 / ratio`` times as much.
        """
        return wheel_torque / self.ratio


class _Coefficients(NamedTuple):
    """Free response after a time t: ``e(t) = g e(0) + h e'(0)``, and its derivative's."""

    g: float
    h: float
    g_rate: float
    h_rate: float


class _FreeResponse:
    """Solutions of the motor's homogeneous equation ``a2 e'' + a1 e' + a0 e = 0``.

    With the roots ``l1 >= l2`` of the equation, ``h = (e^(l1 t) - e^(l2 t)) / (l1 - l2)``
    and ``g = e^(l1 t) - l1 h``, written so that nothing cancels, from two slow real roots to
    a complex pair to a fast root that is all but algebraic.
    """

    def __init__(self, parameters: MotorParameters) -> None:
        a0, a1, a2 = parameters.a0, parameters.a1, parameters.a2
        self.first_order = a2 == 0.0 or not math.isfinite((a1 / a2) ** 2)
        self.frequency = 0.0
        if self.first_order:
            self.slow = -a0 / a1
            self.fast = -math.inf
            return
        self.sum, self.product = -a1 / a2, a0 / a2
        half = self.sum / 2
        discriminant = half * half - self.product
        if discriminant < 0:
            self.frequency = math.sqrt(-discriminant)
            self.slow = self.fast = half
        else:
            self.fast = half - math.sqrt(discriminant)
            self.slow = self.product / self.fast
        self.gap = max(self.slow - self.fast, 0.0)

    def after(self, time: float) -> _Coefficients:
        """Return the coefficients of the response after ``time`` [s]."""
        slow, fast = self.slow, self.fast
        decay = math.exp(slow * time)
        if self.first_order:
            return _Coefficients(decay, 0.0, slow * decay, 0.0)
        if self.frequency > 0:
            cosine = decay * math.cos(self.frequency * time)
            h = decay * math.sin(self.frequency * time) / self.frequency
            return _Coefficients(cosine - slow * h, h, -self.product * h, cosine + slow * h)
        h = -decay * math.expm1(-self.gap * time) / self.gap if self.gap > 0 else decay * time
        h_rate = math.exp(fast * time) + slow * h
        return _Coefficients(decay - slow * h, h, -self.product * h, h_rate)

    def turning_points(self, deviation: float, rate: float, until: float) -> list[float]:
        """Return the instants in ``(0, until)`` at which the response turns round."""
        if self.first_order or until <= 0:
            return []
        if self.frequency > 0:
            across = self.product * deviation - rate * self.slow
            first = (math.atan2(rate * self.frequency, across) % math.pi) / self.frequency
            period = math.pi / self.frequency
            count = max(0, math.ceil((until - first) / period))
            times = [first + k * period for k in range(count)]
        else:
            denominator = -self.slow * (rate - self.fast * deviation)
            if denominator == 0:
                return []
            ratio = rate / denominator
            if self.gap * ratio <= -1:
                return []
            times = [math.log1p(self.gap * ratio) / self.gap if self.gap > 0 else ratio]
        # The instant of breaking loose is a turning point too, up to rounding: not that one.
        shortest = 1e-12 / abs(self.fast)
        return [t for t in times if shortest < t < until]


class Motor:
    """A DC motor with its state, stepped exactly over intervals of constant voltage.

    Parameters
    ----------
    parameters : MotorParameters
        At the motor shaft.
    current, speed, angle : float
        Initial state [A], [rad/s], [rad]; the current follows the voltage where L = 0.

    Attributes
    ----------
    current : float
        Armature current [A].
    speed : float
        [rad/s], motor shaft.
    angle : float
        [rad], motor shaft.

    Examples
    --------
    >>> motor = Motor(MotorParameters(resistance=2.0, inductance=0.0, motor_constant=0.1,
    ...                               inertia=1e-4, viscous_friction=0.0))
    >>> round(motor.step(1.0, 10.0), 6)
    10.0
    """

    def __init__(
        self,
        parameters: MotorParameters,
        *,
        current: float = 0.0,
        speed: float = 0.0,
        angle: float = 0.0,
    ) -> None:
        self.parameters = parameters
        self.current = current
        self.speed = speed
        self.angle = angle
        self._resistance = parameters.resistance
        self._constant = parameters.motor_constant
        self._inertia = parameters.inertia
        self._viscous = parameters.viscous_friction
        self._coulomb = parameters.coulomb_friction
        self._determinant = self._resistance * self._viscous + self._constant**2
        self._free = _FreeResponse(parameters)
        self._electrical = 0.0
        if not self._free.first_order:
            self._electrical = parameters.inductance / parameters.resistance
        self._cache: dict[float, _Coefficients] = {}

    def step(self, voltage: float, dt: float, load_torque: float = 0.0) -> float:
        """Advance by ``dt`` under constant voltage and load.

        Parameters
        ----------
        voltage : float
            Armature voltage [V].
        dt : float
            Length of the step [s], zero or positive, of any size.
        load_torque : float
            Tl [N m] at the motor shaft; positive brakes positive speed.

        Returns
        -------
        float
            Speed at the end of the step [rad/s].

        Raises
        ------
        ParameterError
            When voltage or load is not finite, or ``dt`` is negative or not finite.

        References
        ----------
        Equations of the module; derivation in ``docs/derivations.md``.
        """
        if not (math.isfinite(voltage + load_torque) and 0.0 <= dt < math.inf):
            raise ParameterError(
                f"cannot step by {dt!r} s under {voltage!r} V and {load_torque!r} N m"
            )
        if self._coulomb == 0.0:
            if dt > 0:
                self._move(voltage, load_torque, dt, self._coefficients(dt))
            return self.speed
        remaining = dt
        for _ in range(_MAX_EVENTS_PER_STEP):
            if remaining <= 0:
                break
            if self._sticks(voltage, load_torque):
                remaining -= self._stick(voltage, load_torque, remaining)
            else:
                remaining -= self._slip(voltage, load_torque, remaining)
        return self.speed

    def _coefficients(self, dt: float) -> _Coefficients:
        found = self._cache.get(dt)
        if found is None:
            if len(self._cache) >= _MAX_CACHED_STEPS:
                self._cache.clear()
            found = self._cache[dt] = self._free.after(dt)
        return found

    def _drive(self, voltage: float, load_torque: float) -> float:
        """Torque on the rotor at standstill, before friction [N m]."""
        if self._free.first_order:
            return self._constant * voltage / self._resistance - load_torque
        return self._constant * self.current - load_torque

    def _sticks(self, voltage: float, load_torque: float) -> bool:
        if self.speed != 0.0:
            return False
        drive = self._drive(voltage, load_torque)
        if abs(drive) < self._coulomb:
            return True
        if abs(drive) > self._coulomb or self._free.first_order:
            return abs(drive) <= self._coulomb
        # Exactly at the limit: it sticks unless the current is about to raise the torque.
        return (voltage - self._resistance * self.current) * drive <= 0

    def _stick(self, voltage: float, load_torque: float, dt: float) -> float:
        """Stay at rest until release or the end of the step; return the time that took."""
        final = voltage / self._resistance
        if self._free.first_order:
            self.current = final
            return dt
        torque = self._constant * final - load_torque
        if abs(torque) > self._coulomb:
            limit = (load_torque + math.copysign(self._coulomb, torque)) / self._constant
            release = self._electrical * math.log((final - self.current) / (final - limit))
            if release < dt:
                # A hair beyond the limit, so that rounding cannot hold the rotor for ever.
                self.current = limit + math.copysign(4e-16 * abs(limit), torque)
                return max(release, 0.0)
        self.current = final + (self.current - final) * math.exp(-dt / self._electrical)
        return dt

    def _slip(self, voltage: float, load_torque: float, dt: float) -> float:
        """Turn until standstill or the end of the step; return the time that took."""
        direction = self.speed if self.speed != 0.0 else self._drive(voltage, load_torque)
        sign = math.copysign(1.0, direction)
        torque = load_torque + sign * self._coulomb
        if self._free.first_order:
            self.current = (voltage - self._constant * self.speed) / self._resistance
        final = (self._constant * voltage - self._resistance * torque) / self._determinant
        deviation = self.speed - final
        rate = (self._constant * self.current - self._viscous * self.speed - torque) / self._inertia
        end = self._coefficients(dt)
        last_speed = final + end.g * deviation + end.h * rate
        last_rate = end.g_rate * deviation + end.h_rate * rate
        crosses = sign * last_speed <= 0
        if not crosses and (rate * last_rate < 0 or self._free.frequency * dt > math.pi):
            crosses = True  # It may have turned round and come back inside the step.
        stop = self._standstill(sign, final, deviation, rate, dt) if crosses else None
        if stop is None:
            self._move(voltage, torque, dt, end)
            return dt
        self._move(voltage, torque, stop, self._free.after(stop))
        self.speed = 0.0
        return stop

    def _standstill(
        self, sign: float, final: float, deviation: float, rate: float, until: float
    ) -> float | None:
        """Return the first instant at which the speed reaches zero, None if it does not."""
        bounds = [*self._free.turning_points(deviation, rate, until), until]
        begin = 0.0
        for end in bounds:
            c = self._free.after(end)
            if sign * (final + c.g * deviation + c.h * rate) <= 0:
                return self._root(sign, final, deviation, rate, begin, end)
            begin = end
        return None

    def _root(
        self, sign: float, final: float, deviation: float, rate: float, begin: float, end: float
    ) -> float:
        """Locate the zero of the speed in a bracket where it falls from ``sign`` side to 0."""
        if self._free.first_order:
            return min(max(math.log(-final / deviation) / self._free.slow, begin), end)
        time = end
        for _ in range(100):
            c = self._free.after(time)
            speed = final + c.g * deviation + c.h * rate
            if sign * speed > 0:
                begin = time
            else:
                end = time
            slope = c.g_rate * deviation + c.h_rate * rate
            candidate = time - speed / slope if slope != 0 else begin
            if abs(candidate - time) <= 1e-15 * end:
                return time
            if not begin < candidate < end:
                candidate = 0.5 * (begin + end)
                if not begin < candidate < end:
                    return end
            time = candidate
        return time

    def _move(self, voltage: float, torque: float, dt: float, c: _Coefficients) -> None:
        """Linear motion over ``dt`` against a constant torque."""
        final_speed = (self._constant * voltage - self._resistance * torque) / self._determinant
        deviation = self.speed - final_speed
        if self._free.first_order:
            slow = self._free.slow
            self.angle += final_speed * dt + deviation * math.expm1(slow * dt) / slow
            self.speed = final_speed + deviation * c.g
            self.current = (voltage - self._constant * self.speed) / self._resistance
            return
        rate = (self._constant * self.current - self._viscous * self.speed - torque) / self._inertia
        after = c.g * deviation + c.h * rate
        rate_after = c.g_rate * deviation + c.h_rate * rate
        free = self._free
        # The equation itself, integrated once, gives the integral of the deviation.
        integral = (free.sum * (after - deviation) - (rate_after - rate)) / free.product
        self.angle += final_speed * dt + integral
        self.speed = final_speed + after
        final_current = (self._viscous * voltage + self._constant * torque) / self._determinant
        self.current = (
            final_current + (self._inertia * rate_after + self._viscous * after) / self._constant
        )
