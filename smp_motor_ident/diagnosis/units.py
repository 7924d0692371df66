"""A column that is called a voltage and looks like what a timer counts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from smp_motor_ident.diagnosis.limits import LOW_VOLTAGE
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Record


def whole_volts(records: Sequence[Record]) -> list[Finding]:
    """Return what is to be said of voltages that are whole numbers beyond what robots run on.

    The mean of two such numbers over an interval is a whole one, or half of one.
    """
    largest = max(float(np.nanmax(np.abs(r.voltage))) for r in records)
    whole = all(np.array_equal(2 * r.voltage, np.rint(2 * r.voltage)) for r in records)
    if not whole or largest <= LOW_VOLTAGE.value:
        return []
    return [
        Finding(
            "whole_volts",
            "unreliable",
            f"the voltage is whole numbers up to {largest:g}: it may be a PWM's counts or percent, "
            "and gain and static voltage in units of those",
            {"largest": largest},
            "map it as voltage=COLUMN:pwm with pwm_full_scale and supply_voltage (or :% of it)",
        )
    ]
