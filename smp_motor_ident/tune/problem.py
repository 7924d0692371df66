# SPDX-License-Identifier: Apache-2.0
"""Define the problem of every tuning method: sampled plant, its reductions and its noise."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from smp_motor_control.arrays import Array, Complex
from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.feedback import Feedback, make_grid
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.plant import Plant
from smp_motor_ident.tune.unmodelled import UnmodelledDynamics


@dataclass(frozen=True)
class RequiredMargins:
    """Margins that a method's gains keep on the loop that runs."""

    phase: float  # least phase margin [deg]
    gain: float  # least gain margin, as a factor [-]
    sensitivity: float  # largest Ms [-]


@dataclass(frozen=True)
class FirstOrderDelay:
    """``gain e^{-delay s} / (time_constant s + 1)``, the model of the classical rules."""

    gain: float  # [rad/s/V]
    # time_constant, delay: [s]
    time_constant: float
    delay: float


@dataclass(frozen=True)
class Problem:
    """One motor in one loop, with the targets of the design."""

    plant: Plant  # the sampled motor, a batch of one
    loop: Loop  # the loop that will run
    targets: Mapping[str, Any] = field(default_factory=dict)  # targets of the caller
    unmodelled: UnmodelledDynamics | None = None  # error bound of the model
    speed_noise_factor: float = 1.0  # on the usual limit of the speed's noise

    @cached_property
    def omega(self) -> Array:
        """Frequency grid for searches, shape (f,), [rad/s]."""
        return make_grid(self.plant, 160)

    @cached_property
    def response(self) -> Complex:
        """Response of the plant on the grid, shape (f,)."""
        response: Complex = self.plant.response(self.omega)[0]
        return response

    @cached_property
    def true_response(self) -> Complex:
        """Response to the true speed, not the measured one, on the grid, shape (f,)."""
        response: Complex = self.plant.response(self.omega, true_speed=True)[0]
        return response

    @cached_property
    def uncertain(self) -> Complex:
        """Response through the motor times the bound of its relative error, shape (f,)."""
        if self.unmodelled is None:
            return np.zeros(self.omega.size, dtype=np.complex128)
        through: Complex = self.plant.through_motor(self.omega)[0]
        return through * self.unmodelled.weight(self.omega)

    def closed(self, feedback: Feedback) -> tuple[Complex, Complex]:
        """Return the responses of the controller and of the sensitivity on the grid."""
        control = feedback.response(self.omega, self.loop.sample_time)
        return control, 1 / (1 + control * self.response)

    def unmodelled_gain(self, feedback: Feedback) -> float:
        """Return the largest ``|T| W``: below 1 unmodelled dynamics cannot destabilise."""
        control, sensitivity = self.closed(feedback)
        return float(np.abs(control * self.uncertain * sensitivity).max())

    def control_noise(self, feedback: Feedback) -> float:
        """Return the voltage that measurement noise causes at the controller's output."""
        control, sensitivity = self.closed(feedback)
        return float(self.noise_rms(control * sensitivity))

    @cached_property
    def noise(self) -> Array:
        """Noise density of the measured speed on the grid, shape (f,)."""
        return noise_density(self.plant, self.loop, self.omega)

    def noise_rms(self, response: Complex) -> Array:
        """Return the rms of measurement noise behind some responses of shape (..., f)."""
        power = np.trapezoid(np.abs(response) ** 2 * self.noise, self.omega, axis=-1)
        return np.asarray(np.sqrt(power / self.omega[-1]))

    @cached_property
    def reduced(self) -> FirstOrderDelay:
        """Half-rule reduction; hold, averaging window and the sensor's lag count as delay.

        A pair of complex poles is taken as a double real one of the same sum.
        """
        m, T = self.plant.motors, self.loop.sample_time
        tau = float(m.a1[0] / m.a0[0])
        root = math.sqrt(max(tau**2 - 4 * float(m.a2[0] / m.a0[0]), 0.0))
        fast = 0.5 * (tau - root)
        dead = 0.5 * T + compute_measured_lag(self.plant, self.loop.loop_delay)
        return FirstOrderDelay(1 / float(m.a0[0]), tau - fast / 2, dead + fast / 2)

    @cached_property
    def ultimate(self) -> tuple[float, float]:
        """Ultimate gain [V s/rad] and period [s] of the sampled loop under P control."""
        omega = make_grid(self.plant, 2000)
        response = self.plant.response(omega)[0]
        phase = np.unwrap(np.angle(response))
        beyond = np.flatnonzero(phase <= -np.pi)
        if beyond.size == 0 or beyond[0] == 0:
            return 1 / float(np.abs(response[-1])), 2 * math.pi / float(omega[-1])
        k = int(beyond[0])
        share = (phase[k - 1] + np.pi) / (phase[k - 1] - phase[k])
        w = float(omega[k - 1] + share * (omega[k] - omega[k - 1]))
        return 1 / float(np.abs(self.plant.response(np.array([w]))[0, 0])), 2 * math.pi / w

    def filter_time(self, natural: float) -> float:
        """Return the derivative's filter, not shorter than half a sample."""
        return max(natural, 0.5 * self.loop.sample_time)

    def target(self, name: str, default: float, *, least: float = 0.0) -> float:
        """Return a numeric target, checked."""
        value = check_target(self.targets, name, least)
        return default if value is None else value

    @property
    def structure(self) -> str:
        """Requested structure, ``pi`` or ``pid``; empty for the default."""
        value = self.targets.get("structure")
        if value not in (None, "pi", "pid"):
            raise DesignError(f"structure is {value!r}; it must be pi or pid")
        return str(value or "")


def check_target(targets: Mapping[str, Any], name: str, least: float = 0.0) -> float | None:
    """Return a numeric target, or None where it is not given."""
    value = targets.get(name)
    if value is None:
        return None
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not (number and math.isfinite(value) and value > least):
        raise DesignError(f"{name} is {value!r}; it must be a finite number above {least:g}")
    return float(value)


@dataclass(frozen=True)
class Method:
    """One way of choosing gains."""

    # name, title, source: keyword, words for the table, and where it was published
    name: str
    title: str
    source: str
    required: RequiredMargins  # kept by scaling the rule's gains back where needed
    solve: Callable[[Problem], Feedback]  # from the problem to the feedback gains
    targets: tuple[str, ...] = ()  # keywords that it understands in addition to the common ones


def compute_measured_lag(plant: Plant, delay: float) -> float:
    """Return the lag of the measured speed behind that of the motor [s]."""
    late = delay + float(plant.motors.delay[0])
    if plant.window:
        late += 0.5 / float(plant.average[0, 0])
    return late + float(plant.motors.sensor_lag[0])


def noise_density(plant: Plant, loop: Loop, omega: Array) -> Array:
    """Return the noise density of the measured speed.

    The angle's own noise, and the quantisation of its count, uniform over one, are taken as white,
    then differenced or observed.
    """
    angle = loop.count_angle**2 / 12 + loop.angle_noise**2
    density: Array = plant.angle_noise(omega) * angle
    return density + loop.reported_noise**2
