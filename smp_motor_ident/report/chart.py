# SPDX-License-Identifier: Apache-2.0
"""A chart as data, for the page's interactive script and for print."""

import base64
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array


@dataclass(frozen=True, eq=False)
class Curve:
    """One line, row of points or row of bars over the chart's x."""

    name: str  # in the legend
    y: Array  # shape (n,): NaN where there is nothing
    color: str  # CSS variable of the page
    kind: Literal["line", "points", "bars"] = "line"
    # low, high: shape (n,): band around the line
    low: Array | None = None
    high: Array | None = None
    width: float = 1.5  # of a line [px]


@dataclass(frozen=True, eq=False)
class Chart:
    """Curves over one x."""

    name: str  # identifier in the page
    # title, x_label, y_label: in words, with units
    title: str
    x_label: str
    y_label: str
    x: Array  # shape (n,): increasing
    curves: tuple[Curve, ...]
    log: str = ""
    lines: tuple[float, ...] = ()  # levels that are marked
    # Stretches of x with the CSS variable that shades them
    spans: tuple[tuple[float, float, str], ...] = ()
    group: str = ""  # charts of one group share cursor and zoom in x
    height: int = 220
    view: tuple[float, float] | None = None  # stretch of x that a screen shows at first
    summary: str = ""  # description of the chart for screen readers


def packed(values: Array) -> str:
    """Return numbers as base64 of little-endian float32: 5 bytes each, and quick to read."""
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()


def thin(values: Array, points: int) -> NDArray[np.intp]:
    """Return the indices of the smallest and largest value of each of ``points / 2`` stretches."""
    if values.size <= points:
        return np.arange(values.size)
    size = -(-values.size // (points // 2))
    rows = values[: values.size - values.size % size].reshape(-1, size)
    begin = np.arange(rows.shape[0]) * size
    low = np.where(np.isfinite(rows), rows, np.inf).argmin(axis=1)
    high = np.where(np.isfinite(rows), rows, -np.inf).argmax(axis=1)
    index = np.concatenate((begin + low, begin + high, [0, values.size - 1]))
    return np.asarray(np.unique(index))
