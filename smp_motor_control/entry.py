"""The executables: each imports its program while it already listens to Ctrl-C."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable

# One thread for linear algebra: our matrices are small, and the library waits for a second
# thread in a busy loop, which under SCHED_FIFO may never end.
for _library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")


MOST_DOMAIN = 232
"""DDSI-RTPS 2.5, section 9.6.1.1: the ports of a higher domain lie beyond 65535."""


def _program(module: str, interrupted: int) -> Callable[[], int]:
    """Return what runs ``main`` of a module, and its exit code where Ctrl-C came before that."""

    def run() -> int:
        try:
            return importlib.import_module(module).main() or 0
        except KeyboardInterrupt:
            return interrupted

    return run


def node(name: str, package: str = "smp_motor_control") -> Callable[[], int]:
    """Return what runs the node of that name until a signal, and returns the exit code."""
    program = _program(f"{package}.nodes.{name}", 0)

    def run() -> int:
        if wrong := wrong_domain():
            print(f"{name}: {wrong}", file=sys.stderr)
            return 2
        return program()

    return run


def wrong_domain() -> str:
    """Return what is wrong with ROS_DOMAIN_ID, of which DDS itself says nothing; else nothing."""
    domain = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if domain.isdecimal() and int(domain) <= MOST_DOMAIN:
        return ""
    return f"ROS_DOMAIN_ID is {domain!r}; it must be a whole number from 0 to {MOST_DOMAIN}"


def _tool(name: str) -> Callable[[], int]:
    return _program(f"smp_motor_ident.cli.{name}", 130)


wheel_pid = node("wheel_pid")
motor_plant = node("motor_plant")
skid_steer = node("skid_steer")
teleop_wheels = node("teleop_wheels")
excite = node("excite")
record = node("record", "smp_motor_ident")
play = node("play", "smp_motor_ident")
identifier = node("identifier", "smp_motor_ident")
identify = _tool("identify")
tune = _tool("tune")
commission = _tool("commission")
demo = _tool("demo")
