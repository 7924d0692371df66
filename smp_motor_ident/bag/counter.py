# SPDX-License-Identifier: Apache-2.0
"""Unwrap counters and angles, estimate their width, and detect resets."""

import math
from dataclasses import dataclass, field

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.bag.storage import note
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import (
    MAX_WIDTH_ERROR,
    MIN_ALIASED_STEP_SHARE,
    MIN_ALIASED_STEPS,
    MIN_SATURATED_SHARE,
)

_WIDTHS = (32, 24, 20, 18, 17, 16, 15, 14, 13, 12, 11, 10, 8)
_MIN_WRAPS = 3  # wraps needed to estimate a width; fewer may be faults
_MIN_MOVING_SHARE = 0.8
"""Share of wraps with motion before and after; a counter that toggles stands still."""
_MAX_TURNS = 10  # an angle wraps after at most this many turns, or fractions of one


@dataclass(frozen=True)
class Wrap:
    """The width at which a signal wraps, with its uncertainty."""

    width: float
    deviation: float  # standard deviation of the width
    times: int

    @property
    def is_known(self) -> bool:
        """Whether the width is sure enough to be undone: its error is the motion's."""
        return self.deviation < MAX_WIDTH_ERROR * self.width

    def admits(self, width: float) -> bool:
        """Return whether a width agrees with the signal within four standard deviations."""
        return abs(width - self.width) <= 4 * self.deviation + 1e-6 * self.width


def find_wrap(value: Array) -> Wrap | None:
    """Return the width at which a signal wraps; None if it evidently does not.

    A wrapping signal approaches an end of its range, jumps to the other end and continues in the
    same direction.  The width is the jump plus the expected step.
    """
    steps = np.diff(value)
    span = float(np.ptp(value)) if value.size else 0.0
    jumps = np.flatnonzero(np.abs(steps) > span / 2)
    usual = np.delete(np.abs(steps), jumps)
    if jumps.size < _MIN_WRAPS or not usual.size or usual.max() > span / 4:
        return None
    small = np.pad(steps, 3, constant_values=np.nan)
    small[jumps + 3] = np.nan
    before, after = (np.stack([small[jumps + 3 + k * way] for k in (1, 2, 3)]) for way in (-1, 1))
    seen = np.isfinite(before).any(axis=0) & np.isfinite(after).any(axis=0)
    jump = steps[jumps[seen]]
    if jump.size < _MIN_WRAPS:
        return None
    due = [np.nanmean(side[:, seen], axis=0) for side in (before, after)]
    if min(np.mean(np.sign(jump) * side < 0) for side in due) < _MIN_MOVING_SHARE:
        return None
    widths = np.abs(jump) - np.sign(jump) * (due[0] + due[1]) / 2
    width = float(np.median(widths))
    scatter = 1.4826 * float(np.median(np.abs(widths - width)))
    if scatter > 0.1 * width or width < 0.95 * span:
        return None
    # The expected step lies between those before and after, or slightly beyond.
    scatter = max(scatter, float(np.median(np.abs(due[1] - due[0]))) / 2, 1e-9 * width)
    return Wrap(width, 1.2533 * scatter / np.sqrt(jump.size - 1), jump.size)


def round_to_counts(wrap: Wrap, span: int) -> int:
    """Return the roundest width in counts that a wrap admits: a power of two, or of most zeros."""
    spread = 4 * wrap.deviation + 0.5
    first = max(math.ceil(wrap.width - spread), span + 1)
    last = max(int(wrap.width + spread), first)
    power = 1 << (first - 1).bit_length()
    return next(n for r in (power, 1000, 100, 20, 10, 4, 1) if (n := -(-first // r) * r) <= last)


def round_to_turns(wrap: Wrap) -> float:
    """Return the width in radians: the whole number or part of turns that a wrap admits."""
    turns = [*range(1, _MAX_TURNS + 1), *(1 / k for k in range(2, _MAX_TURNS + 1))]
    return next((w for n in turns if wrap.admits(w := 2 * np.pi * n)), wrap.width)


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """A counter that no longer wraps; ``resets`` are the samples where it started again."""

    count: Integers
    resets: Integers
    findings: list[Finding] = field(default_factory=list)


def unwrap(count: Integers, bits: int | None, expected: Array | None = None) -> Unwrapped:
    """Undo the wrap-around of a counter, and find where it was reset.

    A width of None is found by jumps of one power of two; 0 never wraps.  ``expected`` counts
    between samples, by a measured speed, decide between wrap and reset, and resolve a narrow
    counter that turns by more than half of its range between two samples.
    """
    if count.size < 2:
        return Unwrapped(count, np.zeros(0, np.int64))
    findings = []
    steps = np.diff(count)  # modulo 2^64, as is right for a counter of that width
    guess = np.zeros(steps.size) if expected is None else np.nan_to_num(expected)
    if bits is None and (width := _estimate_width(count, steps, guess)):
        if width & (width - 1):
            text = f"the encoder starts again at {width} counts; it was unwrapped"
            whole = np.rint(np.unwrap(count.astype(np.float64), period=width)).astype(np.int64)
            findings.append(note("counter_wraps", text, counts=width))
            return Unwrapped(whole, np.zeros(0, np.int64), findings)
        bits = width.bit_length() - 1
        text = f"the encoder wraps at 2^{bits} counts; it was unwrapped"
        findings.append(note("counter_wraps", text, bits=bits))
    if bits:
        near = np.rint(guess).astype(np.int64)
        shift = np.int64(64 - bits)
        steps = near + (((steps - near) << shift) >> shift)
    bound = _bound_steps(steps, guess)
    far = 0.0 if expected is not None else 5 * max(float(np.quantile(np.abs(steps), 0.99)), 1.0)
    resets = _find_falls(count, np.abs(steps - guess), bound, far) + 1
    if resets.size:
        findings.append(report_resets("encoder's counter", resets.size))
        steps = steps.copy()
        steps[resets - 1] = np.diff(count)[resets - 1]
    if bits and bits < 62 and expected is None:
        check_aliasing(steps.astype(np.float64), 2.0**bits, "encoder's count")
    whole = np.concatenate([count[:1], count[:1] + np.cumsum(steps)])
    for begin, end in zip(resets, [*resets[1:], count.size]):
        whole[begin:end] += count[begin] - whole[begin]
    return Unwrapped(whole, resets, findings)


def report_resets(what: str, times: int) -> Finding:
    """Report resets of a counter or an angle."""
    text = f"the {what} was reset {times} times; a new segment at each"
    return note("counter_reset", text, "warning", times=times)


def _estimate_width(count: Integers, steps: Integers, guess: Array) -> int:
    """Return the count at which a counter restarts, estimated from its data; 0 if none."""
    bits = _find_width(steps, guess) or _find_filled_width(count, steps)
    wrap = find_wrap(count.astype(np.float64))
    if wrap is None or (bits and wrap.admits(2.0**bits)):
        return 2**bits if bits else 0
    if not wrap.is_known:
        raise BagError(
            f"the encoder's count starts again {wrap.times} times, at about {wrap.width:.4g} "
            "counts, but its range is uncertain; record faster, or a continuous counter"
        )
    return round_to_counts(wrap, int(np.ptp(count)))


def find_full_count(count: Integers) -> int:
    """Return the end of a range at which a counter stays, or 0."""
    for last in (int(count.max()), int(count.min())) if count.size > 1 else ():
        size = last + 1 if last > 0 else -last  # 2^k - 1 at the upper end, -2^k at the lower
        stays = np.mean((count[1:] == last) & (count[:-1] == last)) > MIN_SATURATED_SHARE
        if size >= 2**7 and not size & (size - 1) and stays:
            return last
    return 0


def _bound_steps(steps: Integers, guess: Array) -> float:
    """Return a bound that the steps of a turning motor do not reach."""
    size = np.abs(steps - guess)
    return 10.0 * float(np.quantile(size, 0.9)) + 100.0


def _find_width(steps: Integers, guess: Array) -> int:
    """Return the width at which a counter evidently wraps, or 0."""
    rest = steps - guess
    large = np.abs(rest) > _bound_steps(steps, guess)
    if not large.any() or large.mean() > 0.05:
        return 0
    for bits in _WIDTHS:
        period = float(2**bits)
        after = np.abs(rest[large]) - period
        if np.all(np.abs(after) < period / 8) and np.all(np.abs(rest[~large]) < period / 4):
            return bits
    return 0


def _find_filled_width(count: Integers, steps: Integers) -> int:
    """Return the width that a counter from zero fills with steps of more than half, or 0."""
    bits = int(count.max()).bit_length()
    filled = bits >= 7 and count.min() >= 0 and np.ptp(count) > 0.97 * 2**bits
    return bits if filled and np.mean(np.abs(steps) > 2 ** (bits - 1)) > 0.05 else 0


def angle_resets(angle: Array) -> Integers:
    """Return the samples at which an angle fell to about zero without having turned there."""
    steps = np.abs(np.diff(angle))
    moves = steps[steps > 0]
    if not moves.size:
        return np.zeros(0, np.int64)
    usual, most = np.quantile(moves, (0.9, 0.99))
    return _find_falls(angle, steps, 10 * float(usual), 5 * float(most)) + 1


def _find_falls(value: Array | Integers, rest: Array, bound: float, far: float) -> Integers:
    """Return the steps to about zero that are beyond a bound, and farther, than others are."""
    fell = (rest > bound) & (np.abs(value[1:]) < bound) & (np.abs(value[:-1]) > bound)
    # A reset is one jump between usual steps; jumps to and fro are noise.
    usual = rest <= bound
    fell[1:] &= usual[:-1]
    fell[:-1] &= usual[1:]
    fell[[0, -1]] = False
    fell &= rest > far
    found: Integers = np.flatnonzero(fell)
    return found if found.size <= max(3, 0.01 * rest.size) else np.zeros(0, np.int64)


def unwrap_angle(angle: Array) -> tuple[Array, float]:
    """Unwrap an angle; return it and the width of its wrap, 0 if it has none.

    Within one turn, jumps of more than half of it are wraps.
    """
    sound = np.isfinite(angle)
    values = angle[sound]
    turn = 2 * np.pi
    if values.size < 2:
        return angle, 0.0
    width = turn
    if np.ptp(values) > turn * 1.001 or np.max(np.abs(np.diff(values))) < np.pi:
        wrap = find_wrap(values)
        if wrap is None:
            return angle, 0.0
        width = round_to_turns(wrap)
        if width == wrap.width and not wrap.is_known:
            raise BagError(
                f"the position starts again {wrap.times} times, at about {wrap.width:.4g} rad, "
                "which is not a turn or a part of one; record faster, or a continuous angle"
            )
    result = angle.copy()
    result[sound] = np.unwrap(values, period=width)
    check_aliasing(np.diff(result[sound]), width, "angle")
    return result, width


def check_aliasing(steps: Array, width: float, what: str) -> None:
    """Refuse a signal that turns by more than half of its width between samples.

    Fast rotation then changes into fast reverse rotation without slowing down, several times, or
    once with long runs on either side.
    """
    if np.abs(steps).max(initial=0.0) < MIN_ALIASED_STEP_SHARE * width:
        return
    fast = np.sign(steps) * (np.abs(steps) > width / 8)
    before, a, b, after = fast[1:-4], fast[2:-3], fast[3:-2], fast[4:-1]
    over = (before == a) & (a == -b) & (b == after) & (a != 0)
    over &= np.abs(np.diff(steps))[2:-2] > width / 2
    edge = np.abs(steps) > 0.4 * width
    once = over & (fast[:-5] == before) & (after == fast[5:]) & edge[2:-3] & edge[3:-2]
    if np.count_nonzero(over) + MIN_ALIASED_STEPS * np.count_nonzero(once) >= MIN_ALIASED_STEPS:
        raise BagError(
            f"the {what} turns by more than half of its {width:.4g} from sample to sample, so "
            "its direction is ambiguous; record it at least twice as often, or record the speed"
        )
