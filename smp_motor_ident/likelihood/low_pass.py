"""A speed behind a first-order low-pass, ``lag y' = w - y``, from sample to sample.

Between two samples the speed is taken for the parabola that has its values at both and the angle
between them for its integral: the low-pass answers that exactly, as does a digital one that takes
equally many samples of it in each interval, or of means over equal parts of it.
Derivation: docs/derivations.md, section 4.
"""

from __future__ import annotations

import math

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.sensitivities import D0, LANES, SLOPE, ST, SW
from smp_motor_ident.model.columns import WINDOW
from smp_motor_ident.model.measurement import MEANS

# Interval [s]; weights of the output before, of the speed before and now and of the mean speed
# between, and the derivatives of these four by the lag [1/s].
LOW_PASS_WEIGHTS = 9
SHORT = 0.5  # of an interval, in lags: below it the moments are summed as series
TERMS = 9
LEAST_POLE = 1e-3  # of an interval: a low-pass that passes each mean on as it is


@compiled
def _moments(x: float, moment: Array, slope: Array) -> None:
    """Put ``int_0^1 x exp(-x (1 - u)) u^n du``, n = 0, 1, 2, and its derivative by x."""
    if x < SHORT:
        for n in range(3):
            term = x / (n + 1)
            moment[n] = slope[n] = 0.0
            for k in range(TERMS):
                moment[n] += term
                slope[n] += (k + 1) * term / x
                term *= -x / (n + k + 2)
        return
    gone = math.exp(-x)
    moment[0], slope[0] = 1 - gone, gone
    for n in range(1, 3):
        moment[n] = 1 - n * moment[n - 1] / x
        slope[n] = n * (moment[n - 1] / x - slope[n - 1]) / x


@compiled
def _sampled_moments(x: float, ticks: int, moment: Array, slope: Array) -> None:
    """Put the same of ``y += a (w - y)``, ``a = x / (x + ticks)``, at the ends of equal parts.

    From `MEANS` on w is the mean over each part.
    """
    means = ticks >= MEANS
    ticks -= MEANS * means
    a, by_x = x / (x + ticks), ticks / (x + ticks) ** 2
    moment[:], slope[:] = 0.0, 0.0
    for left in range(ticks):
        kept = (1 - a) ** left
        weight, change = a * kept, (kept - a * left * kept / (1 - a)) * by_x
        u, before = (ticks - left) / ticks, (ticks - left - 1) / ticks
        for n in range(3):
            power = ticks * (u ** (n + 1) - before ** (n + 1)) / (n + 1) if means else u**n
            moment[n] += weight * power
            slope[n] += change * power


@compiled
def weigh(h: float, lag: float, ticks: int, weights: Array) -> None:
    """Put the weights of a step of the low-pass, and their derivatives by the lag.

    Of means that is the low-pass's and half of the time that each of them is over.
    """
    moment, slope = np.empty(3), np.empty(3)
    if ticks >= MEANS:
        lag = max(lag - 0.5 * h / (ticks - MEANS), LEAST_POLE * h)
    x = h / lag
    if ticks:
        _sampled_moments(x, ticks, moment, slope)
    else:
        _moments(x, moment, slope)
    weights[0] = h
    for at, m, share in ((1, moment, 1.0), (5, slope, -x / lag)):
        weights[at] = share * ((1.0 if at == 1 else 0.0) - m[0])
        weights[at + 1] = share * (m[0] - 4 * m[1] + 3 * m[2])
        weights[at + 2] = share * (3 * m[2] - 2 * m[1])
        weights[at + 3] = share * 6 * (m[1] - m[2])


@compiled
def low_passed(
    first: bool, t: float, lag: float, ticks: int, x: Array, m: Array, kept: Array, p: int
) -> float:
    """Return the low-passed speed at a sample; put its derivative into D0.

    It begins ahead of the speed by the number in the angle's place, of which only differences
    count else.  Kept are, in rows, the sample before (time, angle, speed, output and the
    sensitivities of the last three) and the weights of the interval.
    """
    before, c = kept[0], kept[1]
    speed, angle = x[1], x[2]
    if first:
        y = speed + angle
        for j in range(p):
            m[D0 + j] = m[SW + j] + m[ST + j]
    else:
        h = t - before[0]
        if c[0] != h:
            weigh(h, lag, ticks, c)
        mean = (angle - before[1]) / h
        y = c[1] * before[3] + c[2] * before[2] + c[3] * speed + c[4] * mean
        by_lag = c[5] * before[3] + c[6] * before[2] + c[7] * speed + c[8] * mean
        for j in range(p):
            m[D0 + j] = (
                c[1] * before[4 + 2 * p + j]
                + c[2] * before[4 + p + j]
                + c[3] * m[SW + j]
                + c[4] * (m[ST + j] - before[4 + j]) / h
                + 0.5 * by_lag * m[SLOPE + WINDOW * LANES + j]
            )
    before[0], before[1], before[2], before[3] = t, angle, speed, y
    for j in range(p):
        before[4 + j], before[4 + p + j] = m[ST + j], m[SW + j]
        before[4 + 2 * p + j] = m[D0 + j]
    return float(y)
