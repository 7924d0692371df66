"""What a figure needs beside the estimate: measured and simulated speed, and their difference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Role = Literal["estimation", "validation"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured against simulated motor speed over one stretch of data.

    Attributes
    ----------
    role : {'estimation', 'validation'}
        Whether the model was fitted to this stretch or only judged by it.
    source : str
        Name of the bag.
    time : ndarray, shape (n,), [s]
        From the stretch's start.
    voltage, measured, simulated : ndarray, shape (n,), [V, rad/s, rad/s]
        At the motor shaft; NaN where nothing was measured.
    """

    role: Role
    source: str
    time: Array
    voltage: Array
    measured: Array
    simulated: Array

    @property
    def residual(self) -> Array:
        """Measured minus simulated speed [rad/s]."""
        return self.measured - self.simulated


def thin(time: Array, values: Array, points: int = 1600) -> tuple[Array, Array]:
    """Keep the smallest and largest value of each of ``points / 2`` stretches."""
    if values.size <= points:
        return time, values
    size = -(-values.size // (points // 2))
    full = values[: values.size - values.size % size].reshape(-1, size)
    whole = np.where(np.isfinite(full), full, np.nanmean(values))
    begin = np.arange(full.shape[0]) * size
    index = np.concatenate((begin + whole.argmin(axis=1), begin + whole.argmax(axis=1)))
    index = np.unique(np.concatenate((index, [0, values.size - 1])))
    return time[index], values[index]
