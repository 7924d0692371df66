# SPDX-License-Identifier: Apache-2.0
"""Incremental encoders: counts of an angle, rollover, and speed from counts."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from smp_motor_control.arrays import Integers
from smp_motor_control.errors import ParameterError, check_range

MAX_BITS = 63


@dataclass(frozen=True)
class Encoder:
    """An incremental encoder on the motor shaft."""

    counts_per_revolution: float = 500.0  # of the motor, after quadrature decoding
    bits: int = 0  # width of the two's complement counter; 0 never wraps

    def __post_init__(self) -> None:
        check_range("counts_per_revolution", self.counts_per_revolution, 1e-3, 1e9)
        _check_bits(self.bits)

    @property
    def angle_per_count(self) -> float:
        """Motor angle of one count [rad]."""
        return 2 * math.pi / self.counts_per_revolution

    def count(self, angle: float) -> int:
        """Return the counter's value at a motor angle."""
        return wrap(math.floor(angle * self.counts_per_revolution / (2 * math.pi)), self.bits)


def _check_bits(bits: int) -> None:
    if not (isinstance(bits, (int, np.integer)) and (bits == 0 or 2 <= bits <= MAX_BITS)):
        raise ParameterError(f"encoder_bits is {bits!r}; it must be 0 or 2 to {MAX_BITS}")


def wrap(count: int, bits: int) -> int:
    """Return a count wrapped to a two's complement counter of this width."""
    if bits == 0:
        return count
    half = 1 << (bits - 1)
    return ((count + half) & ((1 << bits) - 1)) - half


def unwrap(counts: ArrayLike, bits: int) -> Integers:
    """Return total counts from the values of a wrapping counter."""
    _check_bits(bits)
    shown = np.asarray(counts, dtype=np.int64)
    if bits == 0 or shown.size == 0:
        return shown.copy()
    half = np.int64(1 << (bits - 1))
    mask = np.int64((1 << bits) - 1)
    moved = ((np.diff(shown) + half) & mask) - half
    return np.concatenate((shown[:1], shown[0] + np.cumsum(moved)))


class Unwrapper:
    """Unwrap counts like :func:`unwrap`, one at a time."""

    def __init__(self, bits: int) -> None:
        _check_bits(bits)
        self._bits = int(bits)
        self._shown: int | None = None
        self._total = 0

    def reset(self) -> None:
        """Discard the last count, as after a restart of the hardware."""
        self._shown = None

    def __call__(self, count: int) -> int:
        """Return the total counts after a reading."""
        if self._shown is None:
            self._total = count
        else:
            self._total += wrap(count - self._shown, self._bits)
        self._shown = count
        return self._total


COUNTER_WIDTHS = (8, 16, 24, 32)  # common widths of hardware counters [bits]


class CounterWidth:
    """Detect the width of a counter that wraps unexpectedly.

    A large step is a wrap when removing a full range of some width leaves a step similar to the
    previous one.
    """

    def __init__(self) -> None:
        self._count: int | None = None
        self._moved: int | None = None

    def step(self, count: int) -> int:
        """Return the width [bits] of a counter that has just wrapped; 0 otherwise."""
        before, self._count = self._count, count
        moved = 0 if before is None else count - before
        usual, self._moved = self._moved, moved
        if usual is None or abs(moved) < 1 << (COUNTER_WIDTHS[0] - 1):
            return 0
        for bits in COUNTER_WIDTHS:
            left = wrap(moved, bits)
            alike = abs(left - usual) <= max(abs(usual), 8)
            if alike and abs(moved) > 4 * abs(usual) and abs(moved - left) == 1 << bits:
                self._moved = left
                return bits
        return 0


class DifferencedSpeed:
    """Motor speed [rad/s] by differencing counts over a window of samples."""

    def __init__(self, encoder: Encoder, window: int = 1) -> None:
        if window < 1:
            raise ParameterError(f"difference window is {window!r} samples; it must be at least 1")
        self._scale = encoder.angle_per_count
        self._unwrap = Unwrapper(encoder.bits)
        self._past: deque[tuple[float, int]] = deque(maxlen=window + 1)
        self.total = 0  # unwrapped counts at the last sample

    def reset(self) -> None:
        """Discard past samples, as after lost feedback."""
        self._unwrap.reset()
        self._past.clear()

    def step(self, time: float, count: int) -> float:
        """Return the speed after one more sample; NaN before the second."""
        self.total = total = self._unwrap(count)
        past = self._past
        past.append((time, total))
        first_time, first = past[0]
        elapsed = time - first_time
        if elapsed <= 0:
            return math.nan
        return (total - first) * self._scale / elapsed
