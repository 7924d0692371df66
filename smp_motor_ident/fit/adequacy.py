# SPDX-License-Identifier: Apache-2.0
"""Test the adequacy of a chain by the scatter of the score between parts of a record.

Where the chain is right, the gradient of the likelihood over any part of the record is noise of a
known covariance.  More scatter shows that parts of the record, or regimes of the motion, need
other parameters.

References
----------
H. White, Econometrica 50 (1982), 1-25 (information matrix test); W. K. Newey, K. D. West,
Econometrica 55 (1987), 703-708.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.fit.data import Data
from smp_motor_ident.fit.descend import Fit

BLOCK_COUNT = 24
MAX_ROUNDING_RATIO = 1.1  # residual over an encoder's rounding up to which it is rounding
MAX_ADEQUATE_SCATTER = 2.5  # between parts of a record, over chance
MIN_SIGNIFICANT_EXCESS = 2.0  # standard deviations of a scatter beyond chance


@dataclass(frozen=True, eq=False)
class Scatter:
    """Disagreement between the parts of one partition of a record."""

    name: str
    ratio: float  # of the scatter over that by chance
    significant: bool
    excess: Array  # shape (p, p): covariance of the parameters beyond chance


def leaves_only_rounding(data: Data, motion: Array) -> bool:
    """Tell whether a simulated motion leaves only the rounding of counts or their difference."""
    own = data.quantum / math.sqrt(12 if data.is_angle else 6)
    return float(np.nanstd(data.motion - motion)) < MAX_ROUNDING_RATIO * own


def compute_scatters(data: Data, found: Fit) -> list[Scatter]:
    """Return the scatter of the score over every partition."""
    made = (compute_scatter(found, name, label) for name, label in partition_rows(data, found))
    return [one for one in made if one is not None]


def partition_rows(data: Data, found: Fit) -> Iterator[tuple[str, Integers]]:
    """Yield labels of rows that have independent scores if the chain is right.

    They follow the simulated motion, as the measured one shares its noise with the residual.
    """
    n = len(data)
    yield "autocorrelation", np.arange(n) * BLOCK_COUNT // n
    motion = found.motion
    if data.is_angle:
        motion = np.diff(motion, prepend=np.nan) / np.where(
            data.rows.interval > 0, data.rows.interval, np.nan
        )
    speed = np.nan_to_num(motion)
    size = np.abs(speed)
    level = np.searchsorted(np.quantile(size, [0.15, 0.3, 0.5, 0.7, 0.85]), size)
    yield "speed", (2 * level + (speed > 0)).astype(np.int64)
    quick = np.abs(np.diff(speed, prepend=speed[0]))
    level = np.searchsorted(np.quantile(quick, [0.2, 0.4, 0.6, 0.8]), quick)
    command = np.abs(data.rows.mean_command)
    high = command > np.median(command)
    yield "acceleration", (2 * level + high).astype(np.int64)


def compute_scatter(found: Fit, name: str, label: Integers) -> Scatter | None:
    """Return the scatter between labelled parts."""
    linear = found.linear
    m, p = linear.data.row.size, linear.columns.shape[1]
    count = int(label.max()) + 1
    which = label[linear.data.row]
    scores = linear.columns[:m] * linear.residual[:m, None]
    sums = np.stack([np.bincount(which, s, count) for s in scores.T], axis=1)
    expected = np.zeros((count, p, p))
    columns = linear.columns[:m]
    for k in range(count):
        part = columns[which == k]
        expected[k] = part.T @ part
    inverse = found.covariance
    spread = np.zeros((p, p))
    statistic = dof = 0.0
    for k in range(count):
        share = expected[k]
        # The scores sum to zero, so the covariance of each lacks the part of the fit.
        own = share - share @ inverse @ share
        scale = np.sqrt(np.maximum(np.diag(share), 1e-300))
        if not np.isfinite(own).all() or not np.isfinite(sums[k]).all():
            return None
        values, vectors = np.linalg.eigh(own / np.outer(scale, scale))
        keep = values > 1e-6
        z = (vectors[:, keep].T @ (sums[k] / scale)) / np.sqrt(values[keep])
        statistic += float(z @ z)
        dof += int(keep.sum())
        excess = np.outer(sums[k], sums[k]) - own
        spread += excess
    if dof == 0:
        return None
    values, vectors = np.linalg.eigh(_make_symmetric(inverse @ spread @ inverse))
    excess = (vectors * np.maximum(values, 0.0)) @ vectors.T
    # Stretches of time also scatter by effects outside all regimes, such as late commands.
    least = 0.0 if name == "autocorrelation" else MIN_SIGNIFICANT_EXCESS
    significant = (statistic - dof) / math.sqrt(2 * dof) > least
    return Scatter(name, statistic / dof, significant, excess)


def _make_symmetric(a: Array) -> Array:
    return np.asarray(0.5 * (a + a.T))
