# SPDX-License-Identifier: Apache-2.0
"""``--help`` of the nodes: description and parameters."""

import contextlib
import importlib
import os
import re
import sys

from smp_motor_control.fields import parameters_in


def plain(text: str) -> str:
    """Return a docstring without markup, such as ``motor_state`` or :class:`~wheel.Lease`."""
    return re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", text).replace("``", "")


def main() -> int:
    """Print the help of the node in the module given as argument."""
    module = importlib.import_module(sys.argv[1])
    name = sys.argv[1].rpartition(".")[2]
    usage = f"{name} [--ros-args [-r __ns:=/NAMESPACE] [-p NAME:=VALUE] [--params-file FILE]]"
    lines = [f"usage: {usage}", "", plain(module.__doc__ or "").strip(), "", "parameters:"]
    for parameter, entry in parameters_in(module.Settings).items():
        default = list(entry.default) if isinstance(entry.default, tuple) else entry.default
        fixed = " (fixed at start)" if entry.read_only else ""
        lines += [f"  {parameter} = {default!r}{fixed}", f"      {entry.text}"]
    with contextlib.suppress(BrokenPipeError):
        print("\n".join(lines), flush=True)
        return 0
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader has closed the pipe
    return 0
