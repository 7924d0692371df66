# SPDX-License-Identifier: Apache-2.0
"""Any robot's recordings as records: the only part of the project that reads and writes bags.

`read_records` gives one `smp_motor_ident.record.Record` per wheel, whatever the format; a
mapping says which topics, fields or columns are which signals where the messages are not ours.
`BagWriter` writes.  Each is imported when it is first asked for: who writes needs no reader.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from smp_motor_ident.bag.mapping import MotorMap, Signal, SignalMap, load_mapping, parse_mapping
    from smp_motor_ident.bag.propose import list_topics
    from smp_motor_ident.bag.read import join_records, read_experiments, read_records
    from smp_motor_ident.bag.topics import Listing, TopicInfo
    from smp_motor_ident.bag.writer import BagWriter

__all__ = [
    "BagWriter",
    "Listing",
    "MotorMap",
    "Signal",
    "SignalMap",
    "TopicInfo",
    "join_records",
    "list_topics",
    "load_mapping",
    "parse_mapping",
    "read_experiments",
    "read_records",
]

_HOMES = {
    **dict.fromkeys(
        ("MotorMap", "Signal", "SignalMap", "load_mapping", "parse_mapping"), "mapping"
    ),
    **dict.fromkeys(("Listing", "TopicInfo"), "topics"),
    **dict.fromkeys(("join_records", "read_experiments", "read_records"), "read"),
    **{"list_topics": "propose", "BagWriter": "writer"},
}


def __getattr__(name: str) -> Any:
    """Import a name on first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
