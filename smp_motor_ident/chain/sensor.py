# SPDX-License-Identifier: Apache-2.0
"""Sensors of the motion and of the current."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled
from smp_motor_ident.chain.component import Parameter, Scales, Sensor, Values, compute_lags
from smp_motor_ident.simulate.motion import Motion
from smp_motor_ident.simulate.rows import Rows

MIN_EXCHANGED_LAG_SHARE = 0.05  # of the longer one


class Speed(Sensor):
    """A tachometer: the speed at the row."""

    code, slot, title = "speed", "speed sensor", "speed"

    def sense(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return the speed [rad/s]."""
        return motion.speed


class Angle(Sensor):
    """An encoder: the angle at the row."""

    code, slot, title = "angle", "speed sensor", "angle"

    def sense(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return the angle [rad]."""
        return motion.angle


class EccentricAngle(Angle):
    """An encoder whose disc is off centre: an error of the angle once a turn [rad]."""

    code, title = "encoder_error", "encoder error once a turn"
    advice = "mount the encoder's disc or magnet in the middle of the shaft"
    linear = "eccentricity"
    parameters = (
        Parameter("eccentricity", "1", -0.3, 0.3, typical=0.01),
        Parameter("eccentric_phase", "1", -10.0, 10.0, typical=2.0),
    )

    def sense(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return ``th + e sin(th + phase)``."""
        return np.asarray(
            motion.angle + p["eccentricity"] * np.sin(motion.angle + p["eccentric_phase"])
        )

    def starts(self, scales: Scales) -> Sequence[Mapping[str, float]]:
        """Return two phases a quarter of a turn apart."""
        return [{"eccentricity": 0.01, "eccentric_phase": x} for x in (0.0, 0.5 * np.pi)]


class MeanSpeed(Sensor):
    """A speed that is the mean over a trailing window [s]."""

    code, slot, title = "averaged_speed", "speed sensor", "averaged speed"
    lag, lateness = "window", 0.5
    needs_own_start = True
    parameters = (Parameter("window", "row", 0.0, 200.0, typical=2.0),)
    guesses = (1.0, 2.0, 5.0, 16.0, 40.0)

    def sense(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return ``(th(t) - th(t - window)) / window``."""
        return _mean_speed(rows.time, rows.segment, motion.speed, motion.angle, p["window"])


class DifferencedSpeed(MeanSpeed):
    """A speed that is the difference of counts from row to row, which its steps show."""

    code, title = "differenced_speed", "speed differenced from row to row"
    needs_own_start = False
    lag = ""
    prior = 0.9

    def list_priors(self, scales: Scales) -> Sequence[tuple[Mapping[str, float], float, float]]:
        """Return a window of one row."""
        return (({"window": 1.0}, scales.sample, 0.05 * scales.sample),)


class LowPassedSpeed(Sensor):
    """A speed behind a first-order low-pass [s]."""

    code, slot, title = "low_passed_speed", "speed sensor", "low-passed speed"
    lag = "sensor_lag"
    needs_own_start = True
    parameters = (Parameter("sensor_lag", "s", 0.0, 20.0, typical=0.2),)
    guesses = (0.1, 0.4, 1.0, 3.0)

    def sense(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return ``s`` of ``lag s' = w - s``."""
        return _low_pass(rows.time, rows.segment, motion.speed, motion.angle, p["sensor_lag"])

    def exchange_lags(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Return values of a chain in which the sensor has the motor's longer lag.

        Only friction, which acts before the sensor, tells one from the other.
        """
        lags, second = compute_lags(values)
        other = values.get("sensor_lag", second)
        if other < MIN_EXCHANGED_LAG_SHARE * lags:
            return {}
        ln_a1 = values["ln_a0"] + math.log(other)
        return {
            "sensor_lag": lags - second, "ln_a1": ln_a1, "ln_a2": ln_a1 + math.log(0.01 * other),
        }  # fmt: skip


class Current(Sensor):
    """An ammeter in the armature: the current at the row, with an offset [A]."""

    code, slot, title = "current", "current sensor", "current"
    OFFSET = Parameter("current_offset", "A", -1.0, 1.0)
    parameters: ClassVar[tuple[Parameter, ...]] = (OFFSET,)

    def sense(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return the current [A]."""
        drive = self.law(self.filtered(p, motion, rows, scales), motion)
        return np.asarray(drive * np.exp(-p["ln_r"]) + p["current_offset"])

    def filtered(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return the current times the resistance [V], as the sensor follows it."""
        return motion.drive

    def law(self, drive: Array, motion: Motion) -> Array:
        """Return the sensor's reading of the current."""
        return drive


class MeanCurrent(Current):
    """An ammeter that shows the mean over a trailing window [s]."""

    code, title = "averaged_current", "averaged current"
    parameters = (Current.OFFSET, Parameter("current_window", "row", 0.0, 100.0, typical=1.0))
    guesses: ClassVar[tuple[float, ...]] = (0.6, 1.0, 3.0)
    needs_charge = True

    def filtered(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return the mean of the window."""
        return _mean_speed(
            rows.time, rows.segment, motion.drive, motion.charge, p["current_window"]
        )


class LowPassedCurrent(Current):
    """An ammeter behind a first-order low-pass [s]."""

    code, title = "low_passed_current", "low-passed current"
    parameters = (Current.OFFSET, Parameter("current_lag", "row", 0.0, 1000.0, typical=2.0))
    needs_charge = True

    def filtered(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return the current low-passed."""
        return _low_pass(rows.time, rows.segment, motion.drive, motion.charge, p["current_lag"])

    def starts(self, scales: Scales) -> Sequence[Mapping[str, float]]:
        """Return lags of rows, and such as the motor's."""
        rows = [{"current_lag": n * scales.step} for n in (0.5, 2.0, 8.0)]
        return [*rows, *({"current_lag": x * scales.lag} for x in (0.03, 0.15, 0.6))]


class SmoothedCurrent(Current):
    """An ammeter whose readings are smoothed from row to row, by so many rows late on average."""

    code, title = "smoothed_current", "digitally smoothed current"
    parameters = (Current.OFFSET, Parameter("current_smoothing", "1", 0.0, 200.0))
    guesses = (0.5, 2.0, 8.0)

    def filtered(self, p: Values, motion: Motion, rows: Rows, scales: Scales) -> Array:
        """Return ``y += (i - y) / (1 + rows late)``."""
        return _smooth(rows.segment, motion.drive, p["current_smoothing"])


class UnsignedCurrent(Current):
    """An ammeter that shows the size of the current."""

    code, title = "current_unsigned", "current without sign"

    def law(self, drive: Array, motion: Motion) -> Array:
        """Return the size."""
        return np.abs(drive)


class SupplyCurrent(MeanCurrent):
    """An ammeter at the supply of the bridge: the armature's current times the duty cycle."""

    code, title = "current_of_supply", "current of the supply"
    guesses = (1.0,)

    def law(self, drive: Array, motion: Motion) -> Array:
        """Return power kept from the supply to the motor."""
        return drive * motion.duty


@compiled
def _mean_speed(time: Array, segment: Integers, speed: Array, angle: Array, window: Array) -> Array:
    """Return the mean speed over a trailing window; the angle between rows is a cubic."""
    out = np.empty((speed.shape[1], speed.shape[0]))
    for g in range(segment.shape[0] - 1):
        first, last = segment[g], segment[g + 1]
        for b in range(speed.shape[1]):
            span = window[b]
            j = first
            for k in range(first, last):
                begin = time[k] - span
                while j + 1 < k and time[j + 1] <= begin:
                    j += 1
                if span <= 0.0:
                    out[b, k] = speed[k, b]
                elif begin <= time[first]:  # before the record it ran as at its beginning
                    early = angle[first, b] + speed[first, b] * (begin - time[first])
                    out[b, k] = (angle[k, b] - early) / span
                else:
                    h = time[j + 1] - time[j]
                    x = (begin - time[j]) / h
                    a, c = angle[j, b], angle[j + 1, b]
                    s0, s1 = speed[j, b] * h, speed[j + 1, b] * h
                    y = x * x * (3 - 2 * x)
                    early = a + (c - a) * y + x * (1 - x) * ((1 - x) * s0 - x * s1)
                    out[b, k] = (angle[k, b] - early) / span
    return out.T


@compiled
def _low_pass(time: Array, segment: Integers, speed: Array, angle: Array, lag: Array) -> Array:
    """Return the speed low-passed; between rows it is the parabola of its ends and its mean."""
    out = np.empty((speed.shape[1], speed.shape[0]))
    for g in range(segment.shape[0] - 1):
        first, last = segment[g], segment[g + 1]
        for b in range(speed.shape[1]):
            tau = lag[b]
            s = speed[first, b]
            out[b, first] = s
            for k in range(first + 1, last):
                if tau <= 0.0:
                    out[b, k] = speed[k, b]
                    continue
                h = time[k] - time[k - 1]
                w0, w1 = speed[k - 1, b], speed[k, b]
                mean = (angle[k, b] - angle[k - 1, b]) / h
                # w(x h) = w0 + c1 x + c2 x^2
                c2 = 3.0 * (w0 + w1) - 6.0 * mean
                c1 = w1 - w0 - c2
                r = h / tau
                e = np.exp(-r)
                if r > 1e-3:
                    i0 = 1.0 - e
                    i1 = 1.0 - i0 / r
                    i2 = 1.0 - 2.0 * i1 / r
                else:
                    i0, i1, i2 = r - 0.5 * r * r, 0.5 * r - r * r / 6, r / 3 - r * r / 12
                s = e * s + w0 * i0 + c1 * i1 + c2 * i2
                out[b, k] = s
    return out.T


@compiled
def _smooth(segment: Integers, values: Array, late: Array) -> Array:
    out = np.empty((values.shape[1], values.shape[0]))
    for g in range(segment.shape[0] - 1):
        for b in range(values.shape[1]):
            share = 1.0 / (1.0 + late[b])
            y = values[segment[g], b]
            for k in range(segment[g], segment[g + 1]):
                y += share * (values[k, b] - y)
                out[b, k] = y
    return out.T
