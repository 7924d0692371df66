"""What is put right in records before anything is made of them, in the order in which it is."""

from collections.abc import Iterable

from smp_motor_ident.diagnosis.differenced import counts_again, over_real_intervals
from smp_motor_ident.diagnosis.edge_timer import between_edges, held_of
from smp_motor_ident.diagnosis.glitches import without_glitches
from smp_motor_ident.diagnosis.silence import without_silences
from smp_motor_ident.diagnosis.stamps import bridged, merge_bunches, on_beat
from smp_motor_ident.record import Record


def repaired(records: Iterable[Record]) -> list[Record]:
    """Return records with their stamps, lost rows and readings put right as far as they show it.

    Glitches come late: what a nominal period makes of a late interval looks like one.
    """
    stamped = [merge_bunches(on_beat(over_real_intervals(between_edges(r)))) for r in records]
    whole = counts_again([without_glitches(bridged(r)) for r in stamped])
    return [without_silences(r) for r in whole]


def hides_driver(records: Iterable[Record]) -> bool:
    """Tell whether too little of the slow motion was put right to tell a driver from friction.

    What an edge timer leaves of a motor that comes to rest is as late as a dead zone or a drop
    would make it.
    """
    return any(map(held_of, records))
