# SPDX-License-Identifier: Apache-2.0
"""Excitation voltages for identification, as functions of time.

Every signal is bounded by its amplitude.  Nominal frequencies are multiplied by ``sqrt(1.05)`` so
that no signal is periodic in the sampling: periodic quantisation errors would bias the estimate.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import overload

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.errors import ParameterError, check_positive

DETUNING = math.sqrt(1.05)  # irrational ratio of the actual to the nominal frequency

_MAX_CREST_FACTOR = 2.2
_GOLDEN_RATIO = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, kw_only=True)
class Excitation(ABC):
    """Signal that is bounded by ``amplitude`` and zero before time zero and after its duration."""

    amplitude: float  # largest absolute value [V], positive
    duration: float = math.inf  # [s]
    fade: float = 0.0  # time of fading in, and of fading out [s]

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name not in ("seed", "fade") and (name, value) != ("duration", math.inf):
                check_positive(name, value)
        if not 0.0 <= self.fade <= self.duration / 2:
            raise ParameterError(
                f"fade is {self.fade!r} s; it must be between 0 and half of the duration"
            )

    @overload
    def __call__(self, time: float) -> float: ...
    @overload
    def __call__(self, time: Array) -> Array: ...
    def __call__(self, time: float | Array) -> float | Array:
        """Return the signal [V] at one or many instants [s]."""
        times = np.atleast_1d(np.asarray(time, dtype=np.float64))
        inside = (times >= 0) & (times < self.duration)
        shape = self._shape(np.where(inside, times, 0.0))
        values = np.clip(self.amplitude * shape, -self.amplitude, self.amplitude)
        if self.fade > 0:
            edge = np.minimum(times, self.duration - times) / self.fade
            values *= np.clip(edge, 0.0, 1.0)
        values[~inside] = 0.0
        return float(values[0]) if np.ndim(time) == 0 else values

    @abstractmethod
    def _shape(self, time: Array) -> Array:
        """Return the signal of amplitude 1 at non-negative instants."""


@dataclass(frozen=True, kw_only=True)
class Sine(Excitation):
    """Sine of a nominal ``frequency`` [Hz]."""

    frequency: float = 1.0

    def _shape(self, time: Array) -> Array:
        return np.sin(2 * math.pi * self.frequency * DETUNING * time)


@dataclass(frozen=True, kw_only=True)
class Square(Excitation):
    """Square wave of a nominal ``frequency`` [Hz]."""

    frequency: float = 1.0

    def _shape(self, time: Array) -> Array:
        return np.where((self.frequency * DETUNING * time) % 1.0 < 0.5, 1.0, -1.0)


@dataclass(frozen=True, kw_only=True)
class Fourier(Excitation):
    """Multisine of incommensurate, logarithmically spaced tones; rare peaks are clipped."""

    lowest: float = 0.1  # [Hz]
    highest: float = 20.0  # [Hz]
    tones: int = 24
    seed: int = 0  # signals of different seeds are nearly uncorrelated

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.highest <= self.lowest:
            raise ParameterError(
                f"highest is {self.highest!r} Hz; it must be above lowest, {self.lowest!r} Hz"
            )
        if self.tones < 2:
            raise ParameterError(f"tones is {self.tones!r}; it must be at least 2")

    def _shape(self, time: Array) -> Array:
        frequencies, phases, peak = draw_multisine(self.lowest, self.highest, self.tones, self.seed)
        tones = np.sin(2 * math.pi * np.outer(time, frequencies) + phases)
        summed: Array = tones.sum(axis=1) / peak
        return summed


@lru_cache(maxsize=32)
def draw_multisine(
    lowest: float, highest: float, tones: int, seed: int
) -> tuple[Array, Array, float]:
    """Return frequencies, phases and full scale of the random draw with the lowest peak.

    Incommensurate tones have no period over which to optimise phases.  The best draw still peaks at
    three times its rms value; clipping at 2.2 times affects a few per cent of the time and raises
    the rms voltage by a factor of 1.4.
    """
    # Golden-ratio dither makes the ratios of tones irrational and different for each seed.
    k = np.arange(tones)
    dither = ((k + 1 + 7 * seed) * _GOLDEN_RATIO) % 1.0 - 0.5
    place = np.clip((k + 0.4 * dither) / (tones - 1), 0.0, 1.0)
    frequencies: Array = lowest * (highest / lowest) ** place
    frequencies[0] *= 1 + 1e-3 * (1 + dither[0])
    frequencies[-1] /= 1 + 1e-3 * (1 + dither[-1])
    rng = np.random.default_rng([seed, tones])
    stretch = min(6.0 / lowest, 60.0)
    time = np.arange(0.0, stretch, 1.0 / (8.0 * highest))[:12_000]
    angle = 2 * math.pi * np.outer(time, frequencies)
    sine, cosine = np.sin(angle), np.cos(angle)
    draws = rng.uniform(0.0, 2 * math.pi, (64, tones))
    peaks = np.abs(sine @ np.cos(draws).T + cosine @ np.sin(draws).T).max(axis=0)
    best = int(np.argmin(peaks))
    return (
        frequencies,
        draws[best],
        min(float(peaks[best]), _MAX_CREST_FACTOR * math.sqrt(tones / 2)),
    )


@dataclass(frozen=True, kw_only=True)
class Steps(Excitation):
    """Steps to random voltages of either sign."""

    hold: float = 1.0  # nominal length of a step [s]
    seed: int = 0

    def _shape(self, time: Array) -> Array:
        index = (time * DETUNING / self.hold).astype(np.int64)
        levels = _random_levels(self.seed)
        held: Array = levels[index % levels.size]
        return held


@dataclass(frozen=True, kw_only=True)
class Prbs(Steps):
    """Pseudo-random binary voltage of full amplitude."""

    hold: float = 0.05  # nominal shortest time between two changes of sign [s]

    def _shape(self, time: Array) -> Array:
        return np.where(super()._shape(time) < 0, -1.0, 1.0)


@lru_cache(maxsize=32)
def _random_levels(seed: int) -> Array:
    """Return a long random sequence in [-1, 1] that depends on the seed only."""
    levels: Array = np.random.default_rng(seed).uniform(-1.0, 1.0, 1 << 16)
    return levels


@dataclass(frozen=True, kw_only=True)
class Ramp(Excitation):
    """Slow triangle wave through zero, which shows break-away and standstill."""

    period: float = 20.0  # nominal period [s]

    def _shape(self, time: Array) -> Array:
        phase = (time / (self.period * DETUNING) + 0.75) % 1.0  # begins at zero, rising
        triangle: Array = 4.0 * np.abs(phase - 0.5) - 1.0
        return triangle


SIGNALS: dict[str, type[Excitation]] = {
    kind.__name__.lower(): kind for kind in (Sine, Square, Fourier, Prbs, Steps, Ramp)
}
"""Signals by their names in tools and in the ``excite`` node."""
