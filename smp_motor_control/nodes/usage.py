"""``--help`` of the nodes: what a node does, and its parameters."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from typing import Any

from smp_motor_control.nodes.settings import _entries


def usage(name: str, module: Any) -> str:
    """Return the help of a node."""
    lines = [
        f"usage: {name} [--ros-args [-r __ns:=/NAMESPACE] [-p NAME:=VALUE] [--params-file FILE]]",
        "",
        (module.__doc__ or "").strip(),
        "",
        "parameters:",
    ]
    for parameter, entry in _entries(module.Settings).items():
        default = list(entry.default) if isinstance(entry.default, tuple) else entry.default
        fixed = " (at the start only)" if entry.read_only else ""
        lines.append(f"  {parameter} = {default!r}{fixed}")
        lines.append(f"      {entry.description}")
    return "\n".join(lines)


def main() -> int:
    """Print the help of the node whose module is the argument."""
    module = sys.argv[1]
    text = usage(module.rpartition(".")[2], importlib.import_module(module))
    with contextlib.suppress(BrokenPipeError):
        print(text, flush=True)
        return 0
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader has gone
    return 0
