# SPDX-License-Identifier: Apache-2.0
"""Detection of a sustained oscillation around the set-point.

Gains that are too high for the sampling interval cause such a limit cycle: the voltage switches
between its clamps while the mean speed is right.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

MIN_AMPLITUDE = 0.3  # amplitudes up to this are ignored [rad/s], as by the fault detector

MIN_AMPLITUDE_SHARE = 0.25
"""Amplitudes up to this fraction of the reference are ignored: position-dependent loads."""

MIN_SWING_COUNTS = 3.0  # minimum travel of half a period [counts], above quantisation

MIN_SWING_RAD = 0.01  # the same for an unknown encoder [rad]

HALF_SWINGS = 10  # number of consecutive half periods that show an oscillation

MAX_PERIOD_SCATTER = 0.3  # maximum relative standard deviation of the periods; noise has more

MIN_SMOOTHNESS = 0.75
"""Minimum ratio of error to second difference: 0.41 for white noise, 1 for six-sample cycles."""

MAX_TONE_RESIDUAL = 0.35
"""Maximum power of ``e(k) + e(k-2) - c e(k-1)`` with the best c, relative to the error's.

A cycle of any number of samples has 0, white noise 2."""

SMOOTHNESS_MEMORY_S = 0.5  # averaging time of both ratios

SMOOTHNESS_SAMPLES = 20  # minimum averaging time in samples

OFFSET_MEMORY_S = 1.0  # averaging time of the constant error, as without integral action

MIN_DURATION_S = 1.0  # minimum duration; ringing after a change of set-point is shorter

END_AFTER_S = 3.0  # time without a reversal that ends the oscillation

STEADY_SHARE = 0.1  # tolerated change of a steady reference, as a fraction and in rad/s


class Swing(NamedTuple):
    """Oscillation of a wheel's speed."""

    amplitude: float  # [rad/s]
    frequency: float  # [Hz]


class Oscillation:
    """Detect oscillations of the speed at a steady reference; ``found`` is the present one."""

    def __init__(self) -> None:
        self.min_swing = MIN_SWING_RAD
        self.found: Swing | None = None
        self._begin(math.nan)

    def reset(self) -> None:
        """Discard all evidence, as when the loop restarts."""
        self.found = None
        self._begin(math.nan)

    def set_count(self, angle: float) -> None:
        """Set the wheel's angle per encoder count [rad]."""
        self.min_swing = MIN_SWING_COUNTS * angle

    def _begin(self, reference: float) -> None:
        self._reference = reference
        self._halves: deque[tuple[float, float]] = deque(maxlen=HALF_SWINGS)  # instant, peak
        self._offset = self._before = self._older = 0.0
        self._xx = self._xy = self._yy = 0.0  # means of products of e(k-1) and e(k) + e(k-2)
        self._side = self._time = self._turned_at = self._peak = self._swept = 0.0

    def add(self, dt: float, reference: float, speed: float) -> None:
        """Add a sample."""
        off = abs(reference - self._reference)
        if not off <= STEADY_SHARE * (1.0 + abs(self._reference)):
            self._begin(reference)
        self._time += dt
        error = speed - reference
        self._offset += min(dt / OFFSET_MEMORY_S, 1.0) * (error - self._offset)
        error -= self._offset
        share = min(dt / SMOOTHNESS_MEMORY_S, 1.0 / SMOOTHNESS_SAMPLES)
        x, y = self._before, error + self._older
        self._xx += share * (x * x - self._xx)
        self._xy += share * (x * y - self._xy)
        self._yy += share * (y * y - self._yy)
        self._before, self._older = error, x
        least = max(MIN_AMPLITUDE, MIN_AMPLITUDE_SHARE * abs(reference))
        side = math.copysign(1.0, error) if abs(error) > least else 0.0
        if side and side != self._side:
            self._turn(side)
        elif self._time - self._turned_at > END_AFTER_S:
            self.found = None
            self._begin(reference)
        if error * self._side > 0.0:
            self._swept += abs(error) * dt
            self._peak = max(self._peak, abs(error))

    def _turn(self, side: float) -> None:
        """End a half period and check whether enough of them are consecutive."""
        halves = self._halves
        if self._side and self._swept < self.min_swing:
            halves.clear()
        elif self._side:
            halves.append((self._time, self._peak))
        self._side, self._turned_at, self._peak, self._swept = side, self._time, 0.0, 0.0
        if len(halves) == HALF_SWINGS and self._time > MIN_DURATION_S:
            self.found = _find_cycle(halves) if self._is_regular() else None

    def _is_regular(self) -> bool:
        """Return whether the error is smooth or a tone, which noise is not."""
        xx, xy, yy = self._xx, self._xy, self._yy
        bend = yy - 4.0 * xy + 4.0 * xx
        tone = yy * xx - xy * xy < MAX_TONE_RESIDUAL * xx * xx
        return tone or xx > MIN_SMOOTHNESS * MIN_SMOOTHNESS * bend


def _find_cycle(halves: Sequence[tuple[float, float]]) -> Swing | None:
    """Return the cycle of the half periods; None when their periods scatter."""
    instants, peaks = np.array(halves).T
    periods = instants[2:] - instants[:-2]
    if not periods.std() < MAX_PERIOD_SCATTER * periods.mean():
        return None
    return Swing(float(peaks.mean()), float(1.0 / periods.mean()))
