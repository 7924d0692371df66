# SPDX-License-Identifier: Apache-2.0
"""Read the recordings of any robot as records; only this package reads and writes bags.

`read_records` returns one `smp_motor_ident.record.Record` per wheel, whatever the format.  A
mapping assigns topics, fields or columns to signals; messages of `smp_interfaces` need none.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    **dict.fromkeys(("Signal", "SignalMap", "load_mapping", "parse_mapping"), "mapping"),
    **dict.fromkeys(("join_records", "read_experiments", "read_records"), "read"),
    **{"Listing": "topics", "list_topics": "propose", "BagWriter": "writer"},
}
"""Module of each public name, imported on first use: a writer loads no reader."""


def __getattr__(name: str) -> Any:
    """Import a name on first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
