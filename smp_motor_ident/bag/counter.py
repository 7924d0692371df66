"""Encoder counters that wrap around, and counters that start again."""

from dataclasses import dataclass, field

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.bag.limits import SATURATED
from smp_motor_ident.bag.storage import found
from smp_motor_ident.bag.wraps import angle_of, counts_of, undone, wrap_of
from smp_motor_ident.errors import BagError
from smp_motor_ident.finding import Finding

_WIDTHS = (32, 24, 20, 18, 17, 16, 15, 14, 13, 12, 11, 10, 8)


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """A counter that no longer wraps; ``resets`` are the samples where it started again."""

    count: Integers
    resets: Integers
    findings: list[Finding] = field(default_factory=list)


def unwrap(count: Integers, bits: int | None, expected: Array | None = None) -> Unwrapped:
    """Undo the wrap-around of a counter, and find where it was reset.

    A width of None is found by jumps of one power of two; 0 never wraps.  ``expected`` counts from
    sample to sample, by a measured speed, decide between wrap and reset, and help a narrow
    counter that turns more than half of its range between two samples.
    """
    if count.size < 2:
        return Unwrapped(count, np.zeros(0, np.int64))
    findings = []
    steps = np.diff(count)  # modulo 2^64, as is right for a counter of that width
    guess = np.zeros(steps.size) if expected is None else np.nan_to_num(expected)
    if bits is None and (width := _width_shown(count, steps, guess)):
        if width & (width - 1):
            text = f"the encoder starts again at {width} counts by what it shows; that is undone"
            whole = np.rint(undone(count.astype(np.float64), width)).astype(np.int64)
            findings.append(found("counter_wraps", text, counts=width))
            return Unwrapped(whole, np.zeros(0, np.int64), findings)
        bits = width.bit_length() - 1
        text = f"the encoder wraps at 2^{bits} counts by what it shows; wrap undone"
        findings.append(found("counter_wraps", text, bits=bits))
    if bits:
        near = np.rint(guess).astype(np.int64)
        shift = np.int64(64 - bits)
        steps = near + (((steps - near) << shift) >> shift)
    resets = _resets(count, steps, guess, expected is not None) + 1
    if resets.size:
        text = f"the encoder's counter was reset {resets.size} times; a new segment each"
        findings.append(found("counter_reset", text, "warning", times=resets.size))
        steps = steps.copy()
        steps[resets - 1] = np.diff(count)[resets - 1]
    whole = np.concatenate([count[:1], count[:1] + np.cumsum(steps)])
    for begin, end in zip(resets, [*resets[1:], count.size]):
        whole[begin:end] += count[begin] - whole[begin]
    return Unwrapped(whole, resets, findings)


def _width_shown(count: Integers, steps: Integers, guess: Array) -> int:
    """Return at how many counts a counter starts again by what it shows; 0 where it does not."""
    bits = _width(steps, guess)
    wrap = wrap_of(count.astype(np.float64))
    if wrap is None or (bits and wrap.admits(2.0**bits)):
        return 2**bits if bits else 0
    if not wrap.is_known:
        raise BagError(
            f"the encoder's count starts again {wrap.times} times, at about {wrap.width:.4g}, and "
            "no more is known of where; record faster, or a counter that goes on"
        )
    return counts_of(wrap, int(np.ptp(count)))


def is_full(count: Integers) -> int:
    """Return the last number of a width where a counter stays at it, or 0."""
    for last in (int(count.max()), int(count.min())) if count.size else ():
        size = last + 1 if last > 0 else -last  # 2^k - 1 at the upper end, -2^k at the lower
        stays = np.mean((count[1:] == last) & (count[:-1] == last)) > SATURATED.value
        if size >= 2**7 and not size & (size - 1) and stays:
            return last
    return 0


def _usual(steps: Integers, guess: Array) -> float:
    """Return a bound that the steps of a turning motor do not reach."""
    size = np.abs(steps - guess)
    return 10.0 * float(np.quantile(size, 0.9)) + 100.0


def _width(steps: Integers, guess: Array) -> int:
    """Return the width at which a counter evidently wraps, or 0."""
    rest = steps - guess
    large = np.abs(rest) > _usual(steps, guess)
    if not large.any() or large.mean() > 0.05:
        return 0
    for bits in _WIDTHS:
        period = float(2**bits)
        after = np.abs(rest[large]) - period
        if np.all(np.abs(after) < period / 8) and np.all(np.abs(rest[~large]) < period / 4):
            return bits
    return 0


def _resets(count: Integers, steps: Integers, guess: Array, measured: bool) -> Integers:
    """Return the steps at which the counter fell to about zero without having turned there."""
    rest = np.abs(steps - guess)
    bound = _usual(steps, guess)
    fell = (rest > bound) & (np.abs(count[1:]) < bound) & (np.abs(count[:-1]) > bound)
    # A reset is one jump between usual steps: what jumps to and fro is noise, not a reset.
    usual = rest <= bound
    fell[1:] &= usual[:-1]
    fell[:-1] &= usual[1:]
    fell[[0, -1]] = False
    if not measured:
        fell &= rest > 5 * np.maximum(np.quantile(np.abs(steps), 0.99), 1.0)
    found: Integers = np.flatnonzero(fell)
    return found if found.size <= max(3, 0.01 * steps.size) else np.zeros(0, np.int64)


def unwrap_angle(angle: Array) -> tuple[Array, float]:
    """Undo the wrap-around of an angle; return the width of it, too, 0 where there is none.

    Within one turn, jumps of more than half of it are wraps.
    """
    sound = np.isfinite(angle)
    values = angle[sound]
    turn = 2 * np.pi
    if values.size < 2:
        return angle, 0.0
    width = turn
    if np.ptp(values) > turn * 1.001 or np.max(np.abs(np.diff(values))) < np.pi:
        wrap = wrap_of(values)
        if wrap is None:
            return angle, 0.0
        width = angle_of(wrap)
        if width == wrap.width and not wrap.is_known:
            raise BagError(
                f"the position starts again {wrap.times} times, at about {wrap.width:.4g} rad, "
                "which is no turn or part of one; record faster, or an angle that goes on"
            )
    result = angle.copy()
    result[sound] = undone(values, width)
    return result, width
