"""What a control loop asks of the system and of Python so that it keeps time."""

import contextlib
import gc
import os
from collections.abc import Callable

from rclpy.node import Node


def keep_time(node: Node, priority: int, affinity: tuple[int, ...]) -> list[str]:
    """Ask the system for what a control loop wants, and do without where it says no.

    Freezes what is allocated so far out of the garbage collector's sight and turns the
    collector off; who calls this collects where it does no harm.
    """
    asked: dict[str, Callable[[int], None]] = {}
    if priority > 0:
        asked[f"scheduling_priority {priority}"] = lambda thread: os.sched_setscheduler(
            thread, os.SCHED_FIFO, os.sched_param(priority)
        )
    if affinity:
        asked[f"cpu_affinity {list(affinity)}"] = lambda t: os.sched_setaffinity(t, affinity)
    refused = []
    for what, ask in asked.items():
        try:
            for thread in _threads():
                with contextlib.suppress(ProcessLookupError):
                    ask(thread)
        except (OSError, ValueError, OverflowError, AttributeError) as error:
            refused.append(f"{what} not granted: {error}")
            node.get_logger().warning(f"{refused[-1]}; running without it")
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
