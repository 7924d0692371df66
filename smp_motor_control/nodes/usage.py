"""``--help`` of the nodes: what a node does, and its parameters."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from smp_motor_control.nodes.settings import _entries
from smp_motor_control.ros_arguments import split_arguments


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
    """Print the help of the executable that was called."""
    name = Path(sys.argv[0]).name
    own, _ = split_arguments(sys.argv[1:])
    if not {"-h", "--help"} & set(own):
        print(f"{name}: --help stands before --ros-args", file=sys.stderr)
        return 2
    print(usage(name, importlib.import_module(f"smp_motor_control.nodes.{name}")))
    return 0
