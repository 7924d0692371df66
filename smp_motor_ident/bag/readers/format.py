"""What the registry knows of a format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from smp_motor_ident.bag.unpack import Budget


@dataclass(frozen=True)
class Format:
    """A kind of file: how it is recognised, and what opens it."""

    name: str  # for messages
    suffixes: tuple[str, ...]  # names of such files end so, in lower case
    # How they begin; a file that begins otherwise is none, whatever its name.  Empty for plain
    # text, which only its name tells.
    magic: bytes
    # ``open(path, name, budget)`` gives a `Messages` or a `Tables`; raises `BagError`
    open: Callable[[Path, str, Budget], Any]
    tables: bool = True  # whether it holds columns of numbers instead of serialized messages
