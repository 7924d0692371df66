# SPDX-License-Identifier: Apache-2.0
"""Apply all repairs to records before estimation, in order."""

from collections.abc import Iterable

from smp_motor_ident.quality.differenced import correct_nominal_period, recover_counts
from smp_motor_ident.quality.edge_timer import interpolate_edge_timing
from smp_motor_ident.quality.glitches import remove_glitches
from smp_motor_ident.quality.silence import remove_silences
from smp_motor_ident.quality.stamps import interpolate_lost_voltage, merge_bunches, move_to_beat
from smp_motor_ident.record import Record


def repair_records(records: Iterable[Record]) -> list[Record]:
    """Repair stamps, lost rows and readings of records.

    Glitches come last, because counts over a nominal period give a false glitch at a late interval.
    """
    stamped = [
        merge_bunches(move_to_beat(correct_nominal_period(interpolate_edge_timing(r))))
        for r in records
    ]
    whole = recover_counts([remove_glitches(interpolate_lost_voltage(r)) for r in stamped])
    return [remove_silences(r) for r in whole]
