"""Steady-state Kalman gain of the speed observer for steps of a given length.

References
----------
C. F. Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans. Automatic
Control 23 (1978), for the process noise of a step; R. F. Stengel, *Optimal Control and
Estimation*, Dover 1994, section 4.3, for the steady state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.model import MotorModel

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ObserverNoise:
    """How far the observer trusts the model and the counts.

    Attributes
    ----------
    load : float
        How much the load, as an armature voltage, wanders in one second [V/sqrt(s)].
        Raises the bandwidth with which changes of the load are seen.
    voltage : float
        White noise of the voltage and of what the model leaves out [V sqrt(s)].
    count : float
        Standard deviation of the encoder's error [counts]; ``1/sqrt(12)`` is quantisation
        alone.

    Raises
    ------
    ParameterError
        When a value is not positive.
    """

    load: float = 1.0
    voltage: float = 0.005
    count: float = 1.0 / math.sqrt(12.0)

    def __post_init__(self) -> None:
        for name in ("load", "voltage", "count"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ParameterError(f"observer noise of {name} is {value}: must be positive")


def steady_gain(
    model: MotorModel, quantum: float, noise: ObserverNoise, dt: float
) -> tuple[float, float, float, float, float]:
    """Return the gains of angle, speed, acceleration and load, and the innovation variance.

    The states are scaled (angle by the quantum, speed by tau, acceleration by tau^2) for the
    Riccati equation.

    Parameters
    ----------
    model : MotorModel
        The identified motor.
    quantum : float
        Angle of one count [rad].
    noise : ObserverNoise
        What to expect of load, voltage and encoder.
    dt : float
        Length of the step [s].

    Returns
    -------
    tuple of float
        Gains per radian of innovation [-], [1/s], [1/s^2], [V/rad], and variance [rad^2].
    """
    gain, tau, tp = model.dc_gain, model.time_constant, model.time_constant_product
    if tp:
        drift = np.array(
            [
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 0.0],
                [0.0, -1.0 / tp, -tau / tp, -gain / tp],
                [0.0, 0.0, 0.0, 0.0],
            ]
        )
        scale = np.array([1.0, 1.0 / tau, 1.0 / tau**2, 1.0 / (gain * tau)])
        entry = np.array([0.0, 0.0, gain / tp, 0.0])
    else:
        drift = np.array([[0.0, 1.0, 0.0], [0.0, -1.0 / tau, -gain / tau], [0.0, 0.0, 0.0]])
        scale = np.array([1.0, 1.0 / tau, 1.0 / (gain * tau)])
        entry = np.array([0.0, gain / tau, 0.0])
    wander = np.zeros_like(entry)
    wander[-1] = noise.load
    intensity = noise.voltage**2 * np.outer(entry, entry) + np.outer(wander, wander)
    unit = quantum  # angles in counts
    drift = drift * scale[None, :] / scale[:, None]
    intensity = intensity / np.outer(scale, scale) / unit**2
    size = len(scale)
    block = np.zeros((2 * size, 2 * size))
    block[:size, :size], block[:size, size:], block[size:, size:] = -drift, intensity, drift.T
    exponential = expm(block * dt)
    advance = exponential[size:, size:].T
    process = advance @ exponential[:size, size:]
    process = (process + process.T) / 2.0
    see = np.zeros((size, 1))
    see[0] = 1.0
    covariance = solve_discrete_are(advance.T, see, process, np.array([[noise.count**2]]))
    variance = covariance[0, 0] + noise.count**2
    gains: Array = covariance[:, 0] / variance * scale
    acceleration = float(gains[2]) if tp else 0.0
    return (
        float(gains[0]),
        float(gains[1]),
        acceleration,
        float(gains[-1]),
        float(variance) * unit**2,
    )
