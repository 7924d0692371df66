# SPDX-License-Identifier: Apache-2.0
"""Noise of an output: an autoregression of its residual, and whitening by it.

The order is chosen by the Bayesian information criterion, coefficients by Burg's recursion.  The
first rows of every run are predicted by the lower orders, so that the likelihood is exact.

References
----------
P. Stoica, R. Moses, Spectral Analysis of Signals (2005), section 3.9.3 (Burg); P. J. Brockwell,
R. A. Davis, Time Series: Theory and Methods, 2nd ed. (1991), section 8.7 (exact likelihood).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled, inlined

MAX_ORDER = 24
MAX_USELESS_ORDERS = 8  # tried beyond the best one
MIN_VARIANCE = 1e-300


@dataclass(frozen=True, eq=False)
class Noise:
    """Autoregressive noise of one output.

    ``predictors[m]`` predicts a residual from the ``m`` before it, the latest first;
    ``deviation[m]`` is the standard deviation of its error.
    """

    predictors: Array  # shape (order + 1, order)
    deviation: Array  # shape (order + 1,)
    over_gaps: bool = False  # whether the measured row before is used however long ago it was

    @property
    def order(self) -> int:
        """Number of residuals that predict the next."""
        return int(self.predictors.shape[1])

    @classmethod
    def white(cls, deviation: float) -> Noise:
        """Return noise without memory."""
        return cls(np.zeros((1, 0)), np.array([max(deviation, math.sqrt(MIN_VARIANCE))]))

    @classmethod
    def integrated(cls, deviation: float) -> Noise:
        """Return noise whose difference from row to row is white."""
        last = max(deviation, math.sqrt(MIN_VARIANCE))
        return cls(np.array([[0.0], [1.0]]), np.array([1e3 * last, last]), True)

    def whiten(self, lines: Array, runs: Integers) -> Array:
        """Return lines of shape (c, n) whitened."""
        return _whiten_lines(lines, runs, self.predictors, self.deviation)

    def deviance(self, residual: Array, runs: Integers) -> float:
        """Return -2 log likelihood of a residual of shape (n,), up to a constant."""
        white = self.whiten(residual[None], runs)[0]
        return float(white @ white) + self.log_determinant(runs)

    def log_determinant(self, runs: Integers) -> float:
        """Return the logarithm of the determinant of the noise's covariance over all runs."""
        length = runs[:, 1] - runs[:, 0]
        total = 0.0
        for m in range(self.order):
            total += 2 * math.log(self.deviation[m]) * int((length > m).sum())
        count = int(np.maximum(length - self.order, 0).sum())
        return total + 2 * math.log(self.deviation[-1]) * count


def find_runs(rows: Integers, segment: Integers, gap: int) -> Integers:
    """Return first and end of runs of rows within a segment that are at most ``gap`` apart."""
    which = np.searchsorted(segment, rows, side="right")
    ends = np.flatnonzero((np.diff(which) > 0) | (np.diff(rows) > gap)) + 1
    bounds = np.concatenate([[0], ends, [rows.size]])
    return np.stack([bounds[:-1], bounds[1:]], axis=1).astype(np.int64)


def fit_noise(residual: Array, runs: Integers, max_order: int = MAX_ORDER) -> Noise:
    """Return the noise that a residual shows, shape (n,)."""
    count = int((runs[:, 1] - runs[:, 0]).sum())
    max_order = max(0, min(max_order, count // 20))
    reflection, variance, best = _estimate_reflections(residual, runs, max_order)
    predictors = np.zeros((best + 1, best))
    for m in range(1, best + 1):
        k = reflection[m - 1]
        previous = predictors[m - 1, : m - 1]
        predictors[m, : m - 1] = previous - k * previous[::-1]
        predictors[m, m - 1] = k
    # Variances of the lower orders follow from that of the highest.
    deviation = np.empty(best + 1)
    deviation[best] = math.sqrt(variance[best])
    for m in range(best, 0, -1):
        rest = max(1 - reflection[m - 1] ** 2, 1e-9)
        deviation[m - 1] = deviation[m] / math.sqrt(rest)
    return Noise(predictors, deviation)


@compiled
def _estimate_reflections(
    residual: Array, runs: Integers, max_order: int
) -> tuple[Array, Array, int]:
    """Return reflection coefficients, variance of every order's error, and the best order."""
    forward, backward = residual.copy(), residual.copy()
    reflection, variance = np.zeros(max_order), np.zeros(max_order + 1)
    count, total = 0, 0.0
    for first, last in runs:
        count += last - first
        total += np.dot(residual[first:last], residual[first:last])
    variance[0] = total / max(count, 1)
    # Below its rounding a residual tells nothing.
    floor = max(MIN_VARIANCE, 1e-26 * variance[0])
    variance[0] = max(variance[0], floor)
    price, best, lowest = math.log(max(count, 2)), 0, count * math.log(variance[0])
    for m in range(1, max_order + 1):
        product = energy = 0.0
        for first, last in runs:
            if last - first > m:
                f, b = forward[first + 1 : last - m + 1], backward[first : last - m]
                product += np.dot(f, b)
                energy += np.dot(f, f) + np.dot(b, b)
        c = 2.0 * product / energy if energy > 0.0 else 0.0
        reflection[m - 1] = c
        variance[m] = max(variance[m - 1] * max(1.0 - c * c, 1e-15), floor)
        criterion = count * math.log(variance[m]) + price * m
        if criterion < lowest:
            best, lowest = m, criterion
        if m == best + MAX_USELESS_ORDERS:
            break
        for first, last in runs:
            if last - first > m:
                _raise_order(forward[first : last - m + 1], backward[first : last - m + 1], c)
    return reflection, variance, best


@inlined
def _raise_order(forward: Array, backward: Array, c: float) -> None:
    """Compute the errors of the next order; a forward error moves to the row of its partner."""
    for k in range(forward.size - 1):
        f, b = forward[k + 1], backward[k]
        forward[k], backward[k] = f - c * b, b - c * f


@compiled
def _whiten_lines(lines: Array, runs: Integers, predictors: Array, deviation: Array) -> Array:
    count, n = lines.shape
    order = predictors.shape[1]
    scale = 1.0 / deviation[order]
    out = np.empty((count, n))
    for j in range(count):
        for r in range(runs.shape[0]):
            first, last = runs[r, 0], runs[r, 1]
            begun = min(first + order, last)
            for k in range(first, begun):
                m = k - first
                x = lines[j, k]
                for i in range(m):
                    x -= predictors[m, i] * lines[j, k - 1 - i]
                out[j, k] = x / deviation[m]
            for k in range(begun, last):
                out[j, k] = scale * lines[j, k]
            for i in range(0, order - 1, 2):  # in pairs, which halves the passes
                a, b = scale * predictors[order, i], scale * predictors[order, i + 1]
                for k in range(begun, last):
                    out[j, k] -= a * lines[j, k - 1 - i] + b * lines[j, k - 2 - i]
            if order % 2:
                a = scale * predictors[order, order - 1]
                for k in range(begun, last):
                    out[j, k] -= a * lines[j, k - order]
    return out
