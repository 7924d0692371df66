"""What a chart needs beside the estimate: measured and simulated speed."""

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
