# SPDX-License-Identifier: Apache-2.0
"""Apply all repairs to records before estimation, in order."""

from collections.abc import Iterable

from smp_motor_ident.quality.differenced import counts_again, over_real_intervals
from smp_motor_ident.quality.edge_timer import between_edges
from smp_motor_ident.quality.glitches import without_glitches
from smp_motor_ident.quality.silence import remove_silences
from smp_motor_ident.quality.stamps import bridged, merge_bunches, on_beat
from smp_motor_ident.record import Record


def repaired(records: Iterable[Record]) -> list[Record]:
    """Return records with stamps, lost rows and readings repaired.

    Glitches come last, because counts over a nominal period give a false glitch at a late interval.
    """
    stamped = [merge_bunches(on_beat(over_real_intervals(between_edges(r)))) for r in records]
    whole = counts_again([without_glitches(bridged(r)) for r in stamped])
    return [remove_silences(r) for r in whole]
