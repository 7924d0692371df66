# SPDX-License-Identifier: Apache-2.0
"""Compute the feedback of the controller, and the closed loop.

All at the motor shaft: volts per motor rad/s.  The integral is forward Euler and is used one
step later, the derivative is backward Euler behind its filter, exactly as the running PID does.
"""

from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.arrays import Array, Complex
from smp_motor_ident.tune.plant import SPEED, Plant


@dataclass(frozen=True)
class Feedback:
    """Gains that act on the measurement."""

    p: float  # [V s/rad]
    i: float  # [V/rad]
    d: float = 0.0  # [V s^2/rad]
    filter_time: float = 0.0  # time constant of the derivative's filter [s]

    def scaled(self, factor: float) -> "Feedback":
        """Return the same controller with every gain multiplied by ``factor``."""
        return replace(self, p=self.p * factor, i=self.i * factor, d=self.d * factor)

    def response(self, omega: Array, sample_time: float) -> Complex:
        """Return the frequency response from error to volts."""
        integral, derivative = terms(omega, sample_time, self.filter_time)
        return self.p + self.i * integral + self.d * derivative


def terms(omega: Array, sample_time: float, filter_time: float | Array) -> tuple[Complex, Complex]:
    """Return the responses of integrator and filtered derivative, each with unit gain."""
    z = np.exp(1j * np.asarray(omega) * sample_time)
    keep = filter_time / (filter_time + sample_time)
    return sample_time / (z - 1), (1 - keep) * (z - 1) / (sample_time * (z - keep))


def closed_loop(plant: Plant, feedback: Feedback) -> Array:
    """Return the state matrices of the closed loop of every plant of a batch.

    The state is: motor, the angles run through in the last ``window`` steps or the observer, the
    voltages still under way, integral, and derivative filter.
    """
    n, m, s = plant.taps.shape
    T, window, observer = plant.sample_time, plant.window, plant.observer
    memory = window if observer is None else observer.by_angle.size
    volts, integral = s + memory, s + memory + m - 1
    size = integral + 2
    speed = np.zeros((n, size))
    if observer is not None:
        speed[:, s + SPEED] = 1.0
    elif window:
        speed[:, s:volts] = plant.average
    else:
        speed[:, plant.sensor] = 1.0
    keep = feedback.filter_time / (feedback.filter_time + T)
    unit = np.eye(size)
    # filtered[k] = keep filtered[k-1] + (1 - keep) speed[k]; the last state is filtered[k-1].
    filtered = keep * unit[-1] + (1 - keep) * speed
    rate = (filtered - unit[-1]) / T
    output = unit[integral] - feedback.p * speed - feedback.d * rate
    A = np.zeros((n, size, size))
    A[:, :s, :s] = plant.phi
    A[:, :s] += plant.taps[:, 0, :, None] * output[:, None, :]
    A[:, :s, volts:integral] += np.swapaxes(plant.taps[:, 1:], 1, 2)
    swept = np.zeros((n, size))
    swept[:, :s] = plant.phi_angle
    swept += plant.taps_angle[:, :1] * output
    swept[:, volts:integral] += plant.taps_angle[:, 1:]
    if observer is not None:
        delayed = observer.taps[0] * output
        delayed[:, volts : volts + observer.taps.size - 1] += observer.taps[1:]
        A[:, s:volts, s:volts] = observer.advance
        A[:, s:volts] += observer.by_angle[:, None] * swept[:, None, :]
        A[:, s:volts] += observer.by_voltage[:, None] * delayed[:, None, :]
    elif window:
        A[:, s] = swept
        A[:, s + 1 : volts] = unit[s : volts - 1]
    if m > 1:
        A[:, volts] = output
        A[:, volts + 1 : integral] = unit[volts : integral - 1]
    A[:, integral] = unit[integral] - feedback.i * T * speed
    A[:, -1] = filtered
    return A


def spectral_radius(plant: Plant, feedback: Feedback) -> Array:
    """Return the largest eigenvalue magnitude of every closed loop of a batch."""
    A = closed_loop(plant, feedback)
    if np.ndim(feedback.i) == 0 and feedback.i == 0.0:
        # An integral that nothing feeds stays as it is, and belongs to no loop.
        A = np.delete(np.delete(A, -2, axis=1), -2, axis=2)
    eigenvalues = np.linalg.eigvals(A)
    return np.asarray(np.abs(eigenvalues).max(axis=1), dtype=np.float64)
