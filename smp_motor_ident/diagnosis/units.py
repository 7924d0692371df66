"""A column that is called a voltage and is none that a robot runs on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from smp_motor_ident.diagnosis.limits import EXTRA_LOW_VOLTAGE, LOW_VOLTAGE
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Record


def implausible_voltage(records: Sequence[Record]) -> list[Finding]:
    """Return what is to be said of voltages beyond what robots run on, above all of whole ones.

    The mean of two whole numbers over an interval is a whole one, or half of one.
    """
    largest = max(float(np.nanmax(np.abs(r.voltage))) for r in records)
    if largest <= EXTRA_LOW_VOLTAGE.value:
        return []
    whole = all(np.array_equal(2 * r.voltage, np.rint(2 * r.voltage)) for r in records)
    return [
        Finding(
            "whole_volts" if whole else "high_voltage",
            "unreliable" if whole or largest > LOW_VOLTAGE.value else "warning",
            f"the voltage {'is whole numbers' if whole else 'goes'} up to {largest:.4g}: it may be "
            "a PWM's counts, percent or millivolts, and gain and static voltage in units of those",
            {"largest": largest},
            "map it as voltage=COLUMN:pwm with pwm_full_scale and supply_voltage (or :% of it), "
            "or with its unit, such as voltage=COLUMN:mV",
        )
    ]
