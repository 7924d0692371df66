"""Any robot's recordings as records: the only part of the project that reads and writes bags.

`read_records` gives one `smp_motor_ident.record.Record` per wheel, whatever the format; a
mapping says which topics, fields or columns are which signals where the messages are not ours.
`BagWriter` writes.
"""

from smp_motor_ident.bag.mapping import MotorMap, Signal, SignalMap, load, parse
from smp_motor_ident.bag.offers import Listing, Offer
from smp_motor_ident.bag.propose import list_topics
from smp_motor_ident.bag.read import join_records, read_experiments, read_records
from smp_motor_ident.bag.writer import BagWriter

__all__ = [
    "BagWriter",
    "Listing",
    "MotorMap",
    "Offer",
    "Signal",
    "SignalMap",
    "join_records",
    "list_topics",
    "load",
    "parse",
    "read_experiments",
    "read_records",
]
