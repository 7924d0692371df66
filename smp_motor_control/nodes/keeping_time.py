"""What a control loop asks of the system and of Python so that it keeps time."""

from __future__ import annotations

import contextlib
import gc
import os

from rclpy.node import Node


def keep_time(node: Node, priority: int, affinity: tuple[int, ...]) -> list[str]:
    """Ask the system for what a control loop wants, and do without where it says no.

    Freezes what is allocated so far out of the garbage collector's sight and turns the
    collector off; who calls this collects where it does no harm.
    """
    refused = []
    if priority > 0:
        try:
            for thread in _threads():
                with contextlib.suppress(ProcessLookupError):
                    os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        except (OSError, AttributeError) as error:
            refused.append(f"scheduling_priority {priority} not granted: {error}")
    if affinity:
        try:
            for thread in _threads():
                with contextlib.suppress(ProcessLookupError):
                    os.sched_setaffinity(thread, affinity)
        except (OSError, ValueError, OverflowError, AttributeError) as error:
            refused.append(f"cpu_affinity {list(affinity)} not granted: {error}")
    for line in refused:
        node.get_logger().warning(f"{line}; running without it")
    gc.collect()
    gc.freeze()
    gc.disable()
    return refused


def _threads() -> list[int]:
    """Return all threads of this process: a sample comes through those of the middleware."""
    try:
        return [int(name) for name in os.listdir("/proc/self/task")]
    except OSError:
        return [0]
