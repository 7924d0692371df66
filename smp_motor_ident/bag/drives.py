# SPDX-License-Identifier: Apache-2.0
"""Test whether one signal drives another, to find a voltage and its motion among fields."""

from statistics import NormalDist

import numpy as np
from numpy.fft import irfft, rfft

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.limits import (
    EXPLANATION_LEVEL,
    MAX_LATE_COMMAND_RESIDUAL,
    MAX_SHIFTED_RESIDUAL_RATIO,
    MIN_EXPLAINED_SHARE,
)
from smp_motor_ident.quality.lag import apply_lag, correlate

COMMAND_LAGS, MOTION_LAGS = 6, 2
MAX_DELAY_ROWS = 200  # largest delay of a command behind its motion that is searched [rows]
CLEAR_RATIO = 0.9  # a residual so much smaller than at other shifts is clearly the smallest
SIMILAR_RATIO = 3.0  # up to this ratio residuals are similar
FINE_SEARCH_ROWS = 20  # rows searched around a coarse estimate of the shift
SECOND_LAG_ROWS = (0.0, 0.5, 1.0, 2.0)  # rows of a second lag
MAX_FIT_ROWS = 5000  # rows used for a fit
MOTION_BLOCKS = 200  # averaged stretches of a motion, which reduce a counter's noise


def compute_unexplained_share(u: Array, y: Array) -> float | None:
    """Return the share of a motion that a voltage leaves unexplained; None if it explains nothing.

    Its past must predict the motion better than the motion's own past does (Granger's test, an F
    test of two nested regressions).
    """
    from scipy.special import fdtrc  # takes a while to load

    if y.size < 5 * (COMMAND_LAGS + MOTION_LAGS) or not (np.std(y) > 0 and np.std(u) > 0):
        return None
    y, u = (y - y.mean()) / np.std(y), (u - u.mean()) / np.std(u)
    begin = max(COMMAND_LAGS, MOTION_LAGS)
    own = [y[begin - k : y.size - k] for k in range(1, MOTION_LAGS + 1)]
    driven = [u[begin - k : u.size - k] for k in range(COMMAND_LAGS)]
    target = y[begin:]
    rests = []
    for columns in (own, own + driven):
        matrix = np.stack([*columns, np.ones(target.size)], axis=1)
        solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
        rests.append(float(np.sum((target - matrix @ solution) ** 2)) + 1e-12)
    free = target.size - MOTION_LAGS - COMMAND_LAGS - 1
    ratio = (rests[0] - rests[1]) / COMMAND_LAGS / (rests[1] / free)
    return rests[1] / rests[0] if fdtrc(COMMAND_LAGS, free, ratio) < EXPLANATION_LEVEL else None


def responds_in_its_row(u: Array, y: Array) -> bool:
    """Return whether a motion responds to a command in the same row.

    Then the command acts over the interval that ends at the row, since a later one could not have
    moved anything yet.  The increments of a driven motion jump with its drive: the jumps at steps
    of a held command are compared with those elsewhere (a normal test).  NaN is ignored.
    """
    steps, jumps = np.diff(u), np.diff(y, 2)
    held = (steps[1:-1] != 0) & (steps[:-2] == 0)  # a new command behind one that was held
    new = np.flatnonzero(held & np.isfinite(jumps[:-1] + jumps[1:]))
    if new.size < COMMAND_LAGS:
        return False
    size = steps[new + 1]
    at_once, later = float(size @ jumps[new]), float(size @ jumps[new + 1])
    scatter = float(np.nanstd(np.delete(jumps, new)) * np.linalg.norm(size))
    return at_once > max(-NormalDist().inv_cdf(EXPLANATION_LEVEL) * scatter, later)


def compute_following_share(u: Array, y: Array) -> tuple[float, bool]:
    """Return the share of a signal that follows another with a lag, and whether it is an integral.

    The signal or its increments must be mostly a first-order lag of the other, and fit that better
    than the other without lag: a simultaneous signal (speed and angle, an error) drives nothing.
    """
    if np.count_nonzero(np.diff(u)) < COMMAND_LAGS or _is_clock(u) or _is_clock(y):
        return 0.0, False
    steps = np.diff(y, prepend=y[:1])
    itself = compute_lagged_share(u, y) if _explained_share(u, steps) < MIN_EXPLAINED_SHARE else 0.0
    return max((itself, False), (compute_lagged_share(u, steps), True))


def find_late_rows(u: Array, y: Array) -> int:
    """Return the number of rows by which a command is recorded late; 0 if it leads the motion.

    A cross-correlation of first-order lags with the motion gives a coarse shift; around it,
    friction and the lag are fitted at every shift.  A motion smoothed in both directions leads by
    half of its window.
    """
    most = min(y.size // 10, MAX_DELAY_ROWS)
    u, y = u - u.mean(), y - y.mean()
    if most < 4 or not (np.any(u) and np.any(y)):
        return 0
    shifts = np.arange(-most, most + 1)
    lags = np.geomspace(0.5, y.size / 20, 12)
    shares = np.array(
        [_explained_shares_by_shift(apply_lag(u - u[0], float(lag)), y, shifts) for lag in lags]
    )
    rest = 1 - shares.max(axis=0)
    about = int(shifts[np.argmin(rest)])
    # For a periodic motion, the residual is similar a period, or half of one, nearer to zero
    nearer = shifts[(rest < SIMILAR_RATIO * rest.min()) & (np.abs(shifts) < abs(about) - 10)]
    about = min([about, *nearer.tolist()], key=abs)
    if not 0 < about < most or rest[most + about] > CLEAR_RATIO * rest[: most + 1].min():
        return 0
    lag = float(lags[np.argmax(shares.max(axis=1))])
    left = {shift: _residual_share(u, y, shift, lag) for shift in range(-3, 1)}
    best = about
    for _ in range(FINE_SEARCH_ROWS):  # towards the smallest residual
        near = range(max(best - 2, 1), min(best + 2, most) + 1)
        left |= {shift: _residual_share(u, y, shift, lag) for shift in near if shift not in left}
        if (least := min(near, key=left.__getitem__)) == best:
            break
        best = least
    leading = min(left[shift] for shift in range(-3, 1))
    most_left = min(MAX_LATE_COMMAND_RESIDUAL, MAX_SHIFTED_RESIDUAL_RATIO * leading)
    return best if left[best] < most_left else 0


def _explained_shares_by_shift(x: Array, y: Array, shifts: Integers) -> Array:
    """Return the share of ``y[k]`` explained by a multiple of ``x[k + shift]`` at each shift."""
    x = x - x.mean()
    size = 1 << (x.size + y.size).bit_length()
    both = irfft(rfft(x, size) * np.conj(rfft(y, size)), size)[shifts]
    own, moved = (np.concatenate([[0.0], np.cumsum(v**2)]) for v in (x, y))
    begin, end = np.maximum(shifts, 0), y.size + np.minimum(shifts, 0)
    energy = (own[end] - own[begin]) * (moved[end - shifts] - moved[begin - shifts])
    return np.asarray(both**2 / np.where(energy > 0, energy, np.inf))


def _residual_share(u: Array, y: Array, shift: int, lag: float) -> float:
    """Return the unexplained share of a motion for a shifted command with lag and friction."""
    u, y = (u[shift:], y[: y.size - shift]) if shift > 0 else (u[: u.size + shift], y[-shift:])
    every = max(y.size // MAX_FIT_ROWS, 1)
    some = y[::every]
    best = np.inf
    for trial in lag * np.geomspace(0.4, 2.5, 25):
        driven, friction = apply_lag(u, trial), apply_lag(np.sign(y), trial)
        for second in SECOND_LAG_ROWS:
            matrix = np.stack([apply_lag(driven, second), friction, np.ones(y.size)])[:, ::every]
            both = matrix @ some
            multiples = np.linalg.lstsq(matrix @ matrix.T, both, rcond=None)[0]
            best = min(best, float(some @ some - both @ multiples))
    return best / float(np.sum((some - some.mean()) ** 2))


def compute_lagged_share(u: Array, y: Array) -> float:
    """Return the share of a signal explained by a lag of another; 0 if another shift is better."""
    lags = np.geomspace(1.0, max(y.size / 20, 2.0), 8)
    share = max(_explained_share(apply_lag(u - u[0], float(lag)), y) for lag in lags)
    return share if share > max(MIN_EXPLAINED_SHARE, _explained_share(u, y)) else 0.0


def find_clock(values: list[Array]) -> int | None:
    """Return the column of time: the one that rises most evenly."""
    uneven = {k: np.std(np.diff(x)) / np.ptp(x) for k, x in enumerate(values) if _is_clock(x)}
    return min(uneven, key=lambda k: float(uneven[k]), default=None)


def _is_clock(column: Array) -> bool:
    """Return whether a column rises from each row to the next, by much the same at most times."""
    steps = np.diff(column)
    if not (steps.size and np.mean(steps > 0) > 0.95):
        return False
    low, high = np.quantile(steps, [0.1, 0.9])
    return bool(low > 0.5 * high)


def _explained_share(x: Array, y: Array) -> float:
    """Return the share of the second explained by a positive multiple of the first."""
    every = max(y.size // MOTION_BLOCKS, 1)
    x, y = (v[: v.size // every * every].reshape(-1, every).mean(axis=1) for v in (x, y))
    return max(correlate(x, y), 0.0) ** 2
