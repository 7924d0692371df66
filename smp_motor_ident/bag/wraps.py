"""Where a counter or an angle starts again, and at which width, by what it shows."""

from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.bag.limits import WIDTH_KNOWN

_LEAST = 3  # wraps that tell a width; fewer may be faults
_ONWARD = 0.8
"""Share of the wraps before and after which it moves on; what is thrown to and fro stands."""
_TURNS = 10  # angles start again after up to so many turns, or at up to so many parts of one


@dataclass(frozen=True)
class Wrap:
    """The width at which a signal starts again, and how sure it is."""

    width: float
    deviation: float  # standard deviation of the width
    times: int

    @property
    def is_known(self) -> bool:
        """Whether the width is sure enough to be undone: its error is the motion's."""
        return self.deviation < WIDTH_KNOWN.value * self.width

    def admits(self, width: float) -> bool:
        """Return whether a width is what the signal shows, within four deviations."""
        return abs(width - self.width) <= 4 * self.deviation + 1e-6 * self.width


def wrap_of(value: Array) -> Wrap | None:
    """Return the width at which a signal wraps; None where it evidently does not.

    It nears an end of its range, jumps to the other end, and goes on the same way.  The jump and
    the step that was due instead are the width together.
    """
    steps = np.diff(value)
    span = float(np.ptp(value)) if value.size else 0.0
    jumps = np.flatnonzero(np.abs(steps) > span / 2)
    usual = np.delete(np.abs(steps), jumps)
    if jumps.size < _LEAST or not usual.size or usual.max() > span / 4:
        return None
    small = steps.copy()
    small[jumps] = np.nan
    before = np.stack([_at(small, jumps - k) for k in (1, 2, 3)])
    after = np.stack([_at(small, jumps + k) for k in (1, 2, 3)])
    seen = np.isfinite(before).any(axis=0) & np.isfinite(after).any(axis=0)
    jump = steps[jumps[seen]]
    if jump.size < _LEAST:
        return None
    due = [np.nanmean(side[:, seen], axis=0) for side in (before, after)]
    if min(np.mean(np.sign(jump) * side < 0) for side in due) < _ONWARD:
        return None
    widths = np.abs(jump) - np.sign(jump) * (due[0] + due[1]) / 2
    width = float(np.median(widths))
    scatter = 1.4826 * float(np.median(np.abs(widths - width)))
    if scatter > 0.1 * width or width < 0.95 * span:
        return None
    # The step that was due lies between those before and after, or little beyond.
    scatter = max(scatter, float(np.median(np.abs(due[1] - due[0]))) / 2, 1e-9 * width)
    return Wrap(width, 1.2533 * scatter / np.sqrt(jump.size - 1), jump.size)


def counts_of(wrap: Wrap, span: int) -> int:
    """Return the roundest width in counts that a wrap admits: a power of two, or of most zeros."""
    spread = 4 * wrap.deviation + 0.5
    first = max(int(np.ceil(wrap.width - spread)), span + 1)
    widths = range(first, max(int(wrap.width + spread), first) + 1)
    return max(widths, key=lambda n: (n & (n - 1) == 0, *(n % r == 0 for r in (1000, 100, 10, 4))))


def angle_of(wrap: Wrap) -> float:
    """Return the width in radians: the whole number or part of turns that a wrap admits."""
    turns = [*range(1, _TURNS + 1), *(1 / k for k in range(2, _TURNS + 1))]
    return next((w for n in turns if wrap.admits(w := 2 * np.pi * n)), wrap.width)


def undone(value: Array, width: float) -> Array:
    """Return a signal without its wraps."""
    steps = np.diff(value)
    whole = steps - width * np.rint(steps / width)
    return np.concatenate([value[:1], value[:1] + np.cumsum(whole)])


def _at(value: Array, index: Integers) -> Array:
    inside = (index >= 0) & (index < value.size)
    return np.where(inside, value[np.clip(index, 0, value.size - 1)], np.nan)
