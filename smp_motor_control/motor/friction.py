# SPDX-License-Identifier: Apache-2.0
"""Exact simulation of a DC motor with Coulomb friction under piecewise constant voltage.

Between two friction events the motor is linear,

    L di/dt     = v - R i - K omega
    J domega/dt = K i - b omega - Tc sign(omega) - Tl,

with a closed-form response.  Stopping, reversal and break-away are located inside the step, so
that a step of any length has rounding errors only (derivation: ``docs/derivations.md``).
"""

import math

from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.parameters import MotorParameters
from smp_motor_control.motor.response import Coefficients, FreeResponse

_MAX_CACHED_STEPS = 64
_MAX_EVENTS_PER_STEP = 100_000


class Motor:
    """DC motor with its state, advanced exactly over intervals of constant voltage.

    Parameters
    ----------
    parameters : MotorParameters
        At the motor shaft.
    """

    current: float  # [A]; it follows the voltage where L = 0
    speed: float  # [rad/s]
    angle: float  # [rad]

    def __init__(self, parameters: MotorParameters) -> None:
        self.parameters = parameters
        self.current = self.speed = self.angle = 0.0
        self._resistance = parameters.resistance
        self._constant = parameters.motor_constant
        self._inertia = parameters.inertia
        self._viscous = parameters.viscous_friction
        self._coulomb = parameters.coulomb_friction
        self._determinant = self._resistance * self._viscous + self._constant**2
        self._free = FreeResponse(parameters.time_constant, parameters.time_constant_product)
        self._electrical = 0.0
        if not self._free.first_order:
            self._electrical = parameters.inductance / parameters.resistance
        self._cache: dict[float, Coefficients] = {}

    def step(self, voltage: float, dt: float, load_torque: float = 0.0) -> float:
        """Advance by ``dt`` [s] under constant voltage [V] and load; return the speed [rad/s].

        A positive ``load_torque`` [N m] at the motor shaft brakes positive speed.
        """
        if not (math.isfinite(voltage + load_torque) and 0.0 <= dt < math.inf):
            raise ParameterError(
                f"cannot step by {dt!r} s under {voltage!r} V and {load_torque!r} N m; all must be "
                "finite, the time not negative"
            )
        if self._coulomb == 0.0:
            if dt > 0:
                self._move(voltage, load_torque, dt, self._coefficients(dt))
            return self.speed
        remaining = dt
        for _ in range(_MAX_EVENTS_PER_STEP):
            if remaining <= 0:
                break
            if self._is_stuck(voltage, load_torque):
                remaining -= self._stick(voltage, load_torque, remaining)
            else:
                remaining -= self._slip(voltage, load_torque, remaining)
        return self.speed

    def _coefficients(self, dt: float) -> Coefficients:
        found = self._cache.get(dt)
        if found is None:
            if len(self._cache) >= _MAX_CACHED_STEPS:
                self._cache.clear()
            found = self._cache[dt] = self._free.after(dt)
        return found

    def _standstill_torque(self, voltage: float, load_torque: float) -> float:
        """Torque on the rotor at standstill, before friction [N m]."""
        if self._free.first_order:
            return self._constant * voltage / self._resistance - load_torque
        return self._constant * self.current - load_torque

    def _is_stuck(self, voltage: float, load_torque: float) -> bool:
        if self.speed != 0.0:
            return False
        drive = self._standstill_torque(voltage, load_torque)
        if abs(drive) < self._coulomb:
            return True
        if abs(drive) > self._coulomb or self._free.first_order:
            return abs(drive) <= self._coulomb
        # Exactly at the limit it sticks unless the current is rising.
        return (voltage - self._resistance * self.current) * drive <= 0

    def _stick(self, voltage: float, load_torque: float, dt: float) -> float:
        """Stay at rest until break-away or the end of the step; return the elapsed time."""
        final = voltage / self._resistance
        if self._free.first_order:
            self.current = final
            return dt
        torque = self._constant * final - load_torque
        if abs(torque) > self._coulomb:
            limit = (load_torque + math.copysign(self._coulomb, torque)) / self._constant
            release = self._electrical * math.log((final - self.current) / (final - limit))
            if release < dt:
                # Slightly beyond the limit, so that rounding cannot hold the rotor for ever.
                self.current = limit + math.copysign(4e-16 * abs(limit), torque)
                return max(release, 0.0)
        self.current = final + (self.current - final) * math.exp(-dt / self._electrical)
        return dt

    def _slip(self, voltage: float, load_torque: float, dt: float) -> float:
        """Turn until standstill or the end of the step; return the elapsed time."""
        direction = (
            self.speed if self.speed != 0.0 else self._standstill_torque(voltage, load_torque)
        )
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
            crosses = True  # it may have reversed twice inside the step
        stop = self._find_standstill(sign, final, deviation, rate, dt) if crosses else None
        if stop is None:
            self._move(voltage, torque, dt, end)
            return dt
        self._move(voltage, torque, stop, self._free.after(stop))
        self.speed = 0.0
        return stop

    def _find_standstill(
        self, sign: float, final: float, deviation: float, rate: float, until: float
    ) -> float | None:
        """Return the first instant of zero speed; None if the speed keeps its sign."""
        bounds = [*self._free.turning_points(deviation, rate, until), until]
        begin = 0.0
        for end in bounds:
            c = self._free.after(end)
            if sign * (final + c.g * deviation + c.h * rate) <= 0:
                return self._find_zero_speed(sign, final, deviation, rate, begin, end)
            begin = end
        return None

    def _find_zero_speed(
        self, sign: float, final: float, deviation: float, rate: float, begin: float, end: float
    ) -> float:
        """Locate the zero of the speed inside a bracket."""
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

    def _move(self, voltage: float, torque: float, dt: float, c: Coefficients) -> None:
        """Advance the linear motion by ``dt`` against a constant torque."""
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
        swept = self._free.integral(deviation - after, rate - rate_after)
        self.angle += final_speed * dt + swept
        self.speed = final_speed + after
        final_current = (self._viscous * voltage + self._constant * torque) / self._determinant
        self.current = (
            final_current + (self._inertia * rate_after + self._viscous * after) / self._constant
        )
