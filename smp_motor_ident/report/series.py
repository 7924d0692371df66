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
    """Measured against simulated motor speed over one stretch of data."""

    role: Role  # whether the model was fitted to this stretch or only judged by it
    source: str  # name of the bag
    time: Array  # shape (n,), [s]: from the stretch's start
    # voltage, measured, simulated: shape (n,), [V, rad/s, rad/s]: at the motor shaft; NaN where
    # nothing was measured
    voltage: Array
    measured: Array
    simulated: Array
