"""What `record` and `play` share: patterns of topics, message classes by name."""

from __future__ import annotations

import importlib
import re
from typing import Any

from smp_motor_control.errors import SmpError


def message_class(type_name: str) -> Any | None:
    """Return the class of ``package/msg/Name``; None where it is not installed."""
    package, _, rest = type_name.partition("/")
    name = rest.rpartition("/")[2]
    try:
        found = getattr(importlib.import_module(f"{package}.msg"), name)
        found.__class__.__import_type_support__()
    except Exception:  # a package that was built for another ROS may fail in any way
        return None
    return found


def pattern(option: str, text: str) -> re.Pattern[str] | None:
    """Return a compiled regular expression; None where none is given."""
    try:
        return re.compile(text) if text else None
    except re.error as error:
        raise SmpError(f"{option} {text!r} is no regular expression: {error}") from None
