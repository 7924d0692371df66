# SPDX-License-Identifier: Apache-2.0
"""Odometry of a skid-steered body, with its covariance."""

import math
from collections import deque

import numpy as np

from smp_motor_control.errors import ParameterError, check_positive

MIN_STEP_S = 1e-6  # shortest time step that is integrated


class Odometry:
    """Pose and velocity of the body from the motion of its wheels.

    One step follows an arc, ``h1 = h0 + w dt``,
    ``x += v/w (sin h1 - sin h0)``, ``y -= v/w (cos h1 - cos h0)``.
    The pose is ``x``, ``y`` [m] and ``heading`` [rad], not wrapped, the velocity ``linear`` [m/s]
    and ``angular`` [rad/s].

    References
    ----------
    R. Siegwart, I. Nourbakhsh and D. Scaramuzza, *Introduction to Autonomous Mobile Robots*,
    2nd ed., MIT Press 2011, section 5.2.4, for the growth of the covariance.
    """

    def __init__(
        self,
        wheel_separation: float,  # effective distance between the sides [m]
        left_radius: float,
        right_radius: float,
        window: int = 10,  # steps over which the reported velocity is averaged
        travel_noise: float = 1e-4,  # variance of a side's travel per metre [m^2/m]
        turn_noise: float = 1e-2,  # variance of the heading per radian of turning [rad^2/rad]
        max_wheel_speed: float = math.inf,  # a faster change of position is a counter reset
    ) -> None:
        self.configure(wheel_separation, left_radius, right_radius, travel_noise, turn_noise)
        if window < 1:
            raise ParameterError(f"window is {window} steps; it must be at least 1")
        if not max_wheel_speed > 0.0:
            raise ParameterError(f"max_wheel_speed is {max_wheel_speed} rad/s; it must be positive")
        self.max_wheel_speed = max_wheel_speed
        self._velocities: deque[tuple[float, float]] = deque(maxlen=window)
        self.reset()

    def configure(
        self,
        wheel_separation: float,
        left_radius: float,
        right_radius: float,
        travel_noise: float,
        turn_noise: float,
    ) -> None:
        """Change geometry and noise from the next step on; keep the pose."""
        check_positive("wheel_separation", wheel_separation, "m")
        check_positive("left_radius", left_radius, "m")
        check_positive("right_radius", right_radius, "m")
        check_positive("travel_noise", travel_noise, "m^2/m", or_zero=True)
        check_positive("turn_noise", turn_noise, "rad^2/rad", or_zero=True)
        self._separation, self._left, self._right = wheel_separation, left_radius, right_radius
        self._travel_noise, self._turn_noise = travel_noise, turn_noise

    def reset(self) -> None:
        """Restart at the origin, at rest, without wheel positions."""
        self.set_odometry(0.0, 0.0, 0.0)
        self._positions: tuple[float, float] | None = None
        self.linear = self.angular = 0.0
        self._velocities.clear()

    def set_odometry(self, x: float, y: float, heading: float) -> None:
        """Set the pose, with zero ``covariance``, shape (3, 3)."""
        self.x, self.y, self.heading = x, y, heading
        self.covariance = np.zeros((3, 3))

    def update_from_velocity(self, left: float, right: float, dt: float) -> bool:
        """Integrate both sides' mean wheel speeds [rad/s]; return False for invalid inputs."""
        if not (MIN_STEP_S <= dt < math.inf and math.isfinite(left) and math.isfinite(right)):
            return False
        left, right = left * self._left, right * self._right
        if not math.isfinite((abs(left) + abs(right)) * dt):
            return False
        self._velocities.append(((left + right) / 2.0, (right - left) / self._separation))
        self._integrate(left * dt, right * dt)
        count = len(self._velocities)
        self.linear = sum(v for v, _ in self._velocities) / count
        self.angular = sum(w for _, w in self._velocities) / count
        return True

    def update_from_travel(
        self, left: float, right: float, left_speed: float, right_speed: float
    ) -> bool:
        """Integrate the travel of both sides [rad] and adopt their speeds [rad/s].

        Returns False, without any change, when a number is not finite.
        """
        if not math.isfinite(abs(left) + abs(right) + abs(left_speed) + abs(right_speed)):
            return False
        self._integrate(left * self._left, right * self._right)
        left, right = left_speed * self._left, right_speed * self._right
        self.linear, self.angular = (left + right) / 2.0, (right - left) / self._separation
        return True

    def update_from_position(self, left: float, right: float, dt: float) -> bool:
        """Integrate the change of the wheel positions since the previous step."""
        if not (MIN_STEP_S <= dt < math.inf and math.isfinite(left) and math.isfinite(right)):
            return False
        before, self._positions = self._positions, (left, right)
        if before is None:
            return False
        turned_left, turned_right = left - before[0], right - before[1]
        if max(abs(turned_left), abs(turned_right)) > self.max_wheel_speed * dt:
            return False
        return self.update_from_velocity(turned_left / dt, turned_right / dt, dt)

    def update_open_loop(self, linear: float, angular: float, dt: float) -> bool:
        """Integrate the command [m/s], [rad/s] without wheel feedback."""
        if not (MIN_STEP_S <= dt < math.inf and math.isfinite(linear) and math.isfinite(angular)):
            return False
        self.linear, self.angular = linear, angular
        half = angular * self._separation / 2.0
        self._integrate((linear - half) * dt, (linear + half) * dt)
        return True

    def twist_variances(self, span: float) -> tuple[float, float]:
        """Return the variances of linear and angular velocity averaged over ``span`` seconds."""
        half = self.angular * self._separation / 2.0
        rolled = self._travel_noise * (abs(self.linear - half) + abs(self.linear + half)) / span
        skidded = self._turn_noise * abs(self.angular) / span
        return rolled / 4.0, rolled / self._separation**2 + skidded

    def _integrate(self, left: float, right: float) -> None:
        """Move along an arc, given the travel of both sides [m]."""
        travel, turn = (left + right) / 2.0, (right - left) / self._separation
        self._advance_covariance(left, right, travel, turn)
        heading = self.heading + turn
        if abs(turn) < 1e-6:
            middle = self.heading + turn / 2.0
            self.x += travel * math.cos(middle)
            self.y += travel * math.sin(middle)
        else:
            radius = travel / turn
            self.x += radius * (math.sin(heading) - math.sin(self.heading))
            self.y -= radius * (math.cos(heading) - math.cos(self.heading))
        self.heading = heading

    def _advance_covariance(self, left: float, right: float, travel: float, turn: float) -> None:
        """Advance the covariance: ``P = F P F' + G Q G'`` with inputs (travel, turn)."""
        k, b = self._travel_noise, self._separation
        rolled, uneven = k * (abs(left) + abs(right)), k * (abs(right) - abs(left))
        skidded = self._turn_noise * abs(turn)
        Q = [[rolled / 4.0, uneven / (2.0 * b)], [uneven / (2.0 * b), rolled / (b * b) + skidded]]
        middle = self.heading + turn / 2.0
        cos, sin = math.cos(middle), math.sin(middle)
        across = np.array([-travel * sin, travel * cos])
        F, G = np.eye(3), np.array([[cos, 0.0], [sin, 0.0], [0.0, 1.0]])
        F[:2, 2], G[:2, 1] = across, across / 2.0
        self.covariance = F @ self.covariance @ F.T + G @ Q @ G.T
