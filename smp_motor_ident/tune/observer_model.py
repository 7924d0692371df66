# SPDX-License-Identifier: Apache-2.0
r"""The observer in the loop: a linear filter of angle and voltage.

The observer's angle only ever appears as its difference ``e`` from the counted one, so the filter
has no state that grows.  With ``r = (speed, acceleration, load)`` and, over one sample, the angle
``s`` that was swept and the mean voltage ``v``,

    nu = e + s - F_0 r - G_0 v,   e <- (1 - K_0) nu,   r <- F r + G v + K nu

which is ``state <- advance state + by_angle s + by_voltage v``.

References
----------
R. F. Stengel, Optimal Control and Estimation (1994), section 4.3: the steady-state Kalman filter.
"""

import math
from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array, Complex
from smp_motor_control.motor.model import MotorModel
from smp_motor_control.observer import ObserverNoise, prediction, steady_gain

SPEED = 1
"""Where the speed is in the state."""


@dataclass(frozen=True, eq=False)
class ObserverModel:
    """The observer as a filter, which is the same for all motors of a batch."""

    advance: Array  # shape (q, q)
    # by_angle, by_voltage: shape (q,)
    by_angle: Array
    by_voltage: Array
    # shape (m,): shares of the last controller outputs in the mean voltage of a sample, as the
    # observer gets it and shifts it by the delay of its model
    taps: Array
    variance: float = 1.0  # of the innovation, as the observer takes it [rad^2]

    def transfer(self, z: Complex) -> tuple[Complex, Complex]:
        """Return the transfer from swept angle and from mean voltage to the observed speed."""
        eye = np.eye(self.by_angle.size)
        inputs = np.stack([self.by_angle, self.by_voltage], axis=1)
        solved = np.linalg.solve(z[:, None, None] * eye - self.advance, inputs[None])
        found = np.asarray(solved, dtype=np.complex128)
        return found[:, SPEED, 0], found[:, SPEED, 1]


NO_OBSERVER = ObserverModel(np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros(0))


def observer_model(
    model: MotorModel, sample_time: float, quantum: float, noise: ObserverNoise, loop_delay: float
) -> ObserverModel:
    """Return the steady-state observer of a model as a filter."""
    *gain, variance = steady_gain(model, quantum, noise, sample_time)
    correct = np.array(gain)
    (F,), (G,) = prediction(model, np.array([sample_time]))
    size = correct.size
    # Coefficients of the innovation.
    innovation = np.concatenate([[1.0], -F[0, 1:]])
    advance = np.zeros((size, size))
    advance[0] = (1 - correct[0]) * innovation
    advance[1:, 1:] = F[1:, 1:]
    advance[1:] += correct[1:, None] * innovation
    by_angle = np.concatenate([[1 - correct[0]], correct[1:]])
    by_voltage = np.concatenate([[0.0], G[1:]]) - G[0] * by_angle
    total = loop_delay + model.delay
    whole = math.floor(total / sample_time + 1e-9)
    late = min(max(total / sample_time - whole, 0.0), 1.0)
    taps = np.zeros(whole + 2)
    taps[whole], taps[whole + 1] = 1 - late, late
    return ObserverModel(advance, by_angle, by_voltage, taps if late else taps[:-1], variance)
