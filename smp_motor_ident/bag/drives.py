"""Whether one signal drives another: what tells a voltage and its motion from other fields."""

import numpy as np
from scipy.special import fdtrc, ndtri

from smp_motor_control.arrays import Array
from smp_motor_ident.bag.limits import EXPLAINS
from smp_motor_ident.diagnosis.limits import HALF_EXPLAINED
from smp_motor_ident.likelihood.first_order_lag import lagged

LAGS, OWN = 6, 2
BLOCKS = 200  # stretches over which motions are averaged: in them a counter's noise is small


def unexplained(u: Array, y: Array) -> float | None:
    """Return the share of a motion that a voltage leaves unexplained; None where it explains none.

    Its past must predict the motion better than the motion's own past does (Granger's test, an F
    test of two nested regressions).
    """
    if y.size < 5 * (LAGS + OWN) or not (np.std(y) > 0 and np.std(u) > 0):
        return None
    y, u = (y - y.mean()) / np.std(y), (u - u.mean()) / np.std(u)
    begin = max(LAGS, OWN)
    own = [y[begin - k : y.size - k] for k in range(1, OWN + 1)]
    driven = [u[begin - k : u.size - k] for k in range(LAGS)]
    target = y[begin:]
    rests = []
    for columns in (own, own + driven):
        matrix = np.stack([*columns, np.ones(target.size)], axis=1)
        solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
        rests.append(float(np.sum((target - matrix @ solution) ** 2)) + 1e-12)
    free = target.size - OWN - LAGS - 1
    ratio = (rests[0] - rests[1]) / LAGS / (rests[1] / free)
    return rests[1] / rests[0] if fdtrc(LAGS, free, ratio) < EXPLAINS.value else None


def answers_in_its_row(u: Array, y: Array) -> bool:
    """Return whether a motion answers a command in the very row in which the command is new.

    Then the command is that of the interval that ends at the row: what begins there cannot have
    moved anything yet.  The increments of a motion that is driven jump where the drive does; the
    jumps at steps of a held command are held against those elsewhere (a normal test).  A motion
    that is NaN, such as where another run begins, tells nothing.
    """
    steps, jumps = np.diff(u), np.diff(y, 2)
    held = (steps[1:-1] != 0) & (steps[:-2] == 0)  # a new command behind one that was held
    new = np.flatnonzero(held & np.isfinite(jumps[:-1] + jumps[1:]))
    if new.size < LAGS:
        return False
    size = steps[new + 1]
    at_once, later = float(size @ jumps[new]), float(size @ jumps[new + 1])
    scatter = float(np.nanstd(np.delete(jumps, new)) * np.linalg.norm(size))
    return at_once > max(-float(ndtri(EXPLAINS.value)) * scatter, later)


def follows(u: Array, y: Array) -> tuple[float, bool]:
    """Return how much of a signal follows another late, and whether it is the sum of what does.

    Most of it must be a lag of the first order of the other, or its increments must; and more so
    than the other as it is: what is at once (a speed beside its angle, an error) drives nothing.
    """
    if np.count_nonzero(np.diff(u)) < LAGS or _is_clock(u) or _is_clock(y):
        return 0.0, False
    steps = np.diff(y, prepend=y[:1])
    itself = late(u, y) if _alike(u, steps) < HALF_EXPLAINED.value else 0.0
    return max((itself, False), (late(u, steps), True))


def late(u: Array, y: Array) -> float:
    """Return which share of a signal a lag of another explains; 0 where that is not its best."""
    lags = np.geomspace(1.0, max(y.size / 20, 2.0), 8)
    share = max(_alike(lagged(u - u[0], float(lag)), y) for lag in lags)
    return share if share > max(HALF_EXPLAINED.value, _alike(u, y)) else 0.0


def clock_of(values: list[Array]) -> int | None:
    """Return which of several columns is the time: the one that rises most evenly."""
    uneven = {k: np.std(np.diff(x)) / np.ptp(x) for k, x in enumerate(values) if _is_clock(x)}
    return min(uneven, key=lambda k: float(uneven[k]), default=None)


def _is_clock(column: Array) -> bool:
    """Return whether a column rises from each row to the next, by much the same at most times."""
    steps = np.diff(column)
    if not (steps.size and np.mean(steps > 0) > 0.95):
        return False
    low, high = np.quantile(steps, [0.1, 0.9])
    return bool(low > 0.5 * high)


def _alike(x: Array, y: Array) -> float:
    """Return which share of the second a positive multiple of the first explains."""
    every = max(y.size // BLOCKS, 1)
    x, y = (v[: v.size // every * every].reshape(-1, every).mean(axis=1) for v in (x, y))
    x, y = x - x.mean(), y - y.mean()
    both = float((x @ x) * (y @ y))
    return max(float(x @ y), 0.0) ** 2 / both if both > 0 else 0.0
