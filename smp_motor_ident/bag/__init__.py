# SPDX-License-Identifier: Apache-2.0
"""Any robot's recordings as records: the only part of the project that reads and writes bags.

`read_records` gives one `smp_motor_ident.record.Record` per wheel, whatever the format; a
mapping says which topics, fields or columns are which signals where the messages are not ours.
`BagWriter` writes.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    **dict.fromkeys(("Signal", "SignalMap", "load_mapping", "parse_mapping"), "mapping"),
    **dict.fromkeys(("join_records", "read_experiments", "read_records"), "read"),
    **{"Listing": "topics", "list_topics": "propose", "BagWriter": "writer"},
}
"""Public names, each imported when it is first asked for: who writes needs no reader."""


def __getattr__(name: str) -> Any:
    """Import a name on first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
