# SPDX-License-Identifier: Apache-2.0
"""Detect wrong units of voltage, angle, speed and time."""

import math
from collections.abc import Iterator, Sequence
from statistics import median_low

import numpy as np

from smp_motor_ident.errors import SignalError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import (
    EXTRA_LOW_VOLTAGE,
    LOW_VOLTAGE,
    MAX_DC_GAIN,
    MAX_MOTOR_SPEED,
    MAX_TIME_CONSTANT,
    MAX_USUAL_SPEED,
)
from smp_motor_ident.record import Hardware, Record

RATIOS = {
    30 / math.pi: "in rpm, the other in radians",
    60.0: "in rpm, the other in turns",
    6.0: "in rpm, the other in degrees",
    180 / math.pi: "in degrees, the other in radians",
    2 * math.pi: "in radians, the other in turns",
    360.0: "in degrees, the other in turns",
    1000.0: "in thousandths of the other's unit",
}
"""Units of a speed and an angle, by the factor between them."""
RATIO_TOLERANCE = 0.01  # relative; gear ratios usually differ by more


def explain_ratio(ratio: float, hardware: Hardware) -> str:
    """Return the cause of a ratio between a speed and the slope of its angle, with advice."""
    for size, words in RATIOS.items():
        for factor, to in ((size, "the speed is"), (1 / size, "the angle is")):
            if abs(ratio / factor - 1) < RATIO_TOLERANCE:
                return f"{to} {words}: map it with its unit, such as velocity=COLUMN:rpm"
    return (
        f"wrong gear ratio (now {hardware.gear_ratio:g}) or counts per revolution (now "
        f"{hardware.counts_per_revolution or 0:g}), correct the motor description"
    )


def refuse_mixed_time_units(records: Sequence[Record]) -> None:
    """Refuse records whose sampling intervals differ by a factor of a thousand."""
    usual = median_low([r.sample_time for r in records])
    for record in records:
        for factor in (1e-6, 1e-3, 1e3, 1e6):
            if abs(record.sample_time / usual / factor - 1) < RATIO_TOLERANCE:
                raise SignalError(
                    f"{record.source or 'a record'}: a sample every {record.sample_time:.3g} s, "
                    f"{factor:g} times as long as in the other recordings: the time of one is in "
                    "another unit; map it with its own, such as time=COLUMN:ms, or leave it out"
                )


def check_voltage(records: Sequence[Record]) -> Iterator[Finding]:
    """Report voltages beyond those of robots, especially whole numbers.

    The mean of two whole numbers over an interval is a whole or half number.
    """
    largest = max(float(np.nanmax(np.abs(r.voltage))) for r in records)
    if largest <= EXTRA_LOW_VOLTAGE:
        return
    whole = all(np.array_equal(2 * r.voltage, np.rint(2 * r.voltage)) for r in records)
    yield Finding(
        "whole_volts" if whole else "high_voltage",
        "unreliable" if whole or largest > LOW_VOLTAGE else "warning",
        f"the voltage {'is whole numbers' if whole else 'goes'} up to {largest:.4g}: it may be the "
        "counts of a PWM, percent or millivolts; gain and static voltage then have this unit",
        {"largest": largest},
        "map it as voltage=COLUMN:pwm with pwm_full_scale and supply_voltage (or :% of it), or "
        "with its unit, such as voltage=COLUMN:mV",
    )


def check_plausibility(
    records: Sequence[Record], gain: float, lag: float, friction: float
) -> Iterator[Finding]:
    """Report impossible or implausible motors, which indicate wrong units."""
    longest = max(r.duration for r in records)
    if lag > longest:
        yield Finding(
            "never_steady",
            "unreliable",
            f"the speed never settles: with a time constant of {lag:.3g} s in {longest:.3g} s of "
            f"record, only the ratio of gain to time constant is known ({gain / lag:.3g} rad/s^2 "
            "per volt)",
            {"time_constant": lag, "duration": longest, "acceleration": gain / lag},
            "map the speed as position if it is an angle, else record until the speed is steady",
        )
    top = max(
        max(float(np.abs(r.voltage).max()), r.hardware.supply_voltage or 0.0) for r in records
    )
    speed = gain * max(top - friction, 0.0)
    words = f"a speed of {speed * 30 / math.pi:.3g} rpm at {top:.3g} V"
    odd = {
        f"a time constant of {lag:.3g} s": lag > MAX_TIME_CONSTANT,
        f"a gain of {gain:.3g} rad/s per volt": gain > MAX_DC_GAIN,
        words: speed > MAX_MOTOR_SPEED,
    }
    numbers: dict[str, float | str | None]
    numbers = {"time_constant": lag, "dc_gain": gain, "speed": speed, "voltage": top}
    advice = (
        "check the units of time (ms taken for s?), speed (rpm or degrees taken for radians?) and "
        "voltage (PWM, or a command in amperes, taken for volts?)"
    )
    if any(odd.values()):
        message = f"no motor has {' and '.join(word for word, there in odd.items() if there)}"
        yield Finding("implausible_motor", "warning", message, numbers, advice)
    elif speed > MAX_USUAL_SPEED:
        message = f"the motor has {words}; only brushed motors of toys are as fast"
        yield Finding("fast_motor", "warning", message, numbers, advice)
