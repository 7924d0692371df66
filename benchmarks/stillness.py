# SPDX-License-Identifier: Apache-2.0
"""Detect stalls of the machine by a real-time process on every processor.

The host of a virtual machine may pause it for some milliseconds, which no counter inside shows.
A process per processor sleeps for a millisecond again and again with the highest real-time
priority; when it wakes late, no other program could have run.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from multiprocessing.connection import Connection

import numpy as np

PRIORITY = 99
PERIOD = 0.0005
LATE = 0.0005
"""How late a witness must wake to count [s]; usual is a twentieth of that."""


def _watch(processor: int, line: Connection) -> None:
    """Send begin and end of each stand-still [ns of the system's clock] when asked."""
    os.sched_setaffinity(0, {processor})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    found: list[tuple[int, int]] = []
    while not line.poll():
        due = time.time_ns() + round(PERIOD * 1e9)
        time.sleep(PERIOD)
        now = time.time_ns()
        if now - due > LATE * 1e9:
            found.append((due, now))
    line.send(found)


class Witness:
    """Watches all processors from its making until :meth:`stop`; needs real-time priority."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._lines, self._processes = [], []
        for processor in sorted(os.sched_getaffinity(0)):
            ours, its = context.Pipe()
            process = context.Process(target=_watch, args=(processor, its), daemon=True)
            process.start()
            self._lines.append(ours)
            self._processes.append(process)

    def stop(self) -> np.ndarray:
        """Return begin and end of every stand-still, (n, 2) [ns of the system's clock]."""
        for line in self._lines:
            line.send(None)
        found = [pair for line in self._lines for pair in line.recv()]
        for process in self._processes:
            process.join(5.0)
        return np.array(sorted(found), dtype=np.int64).reshape(-1, 2)


def touched(begin: np.ndarray, end: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Tell which of the spans meet a stand-still; ``begin`` and ``end`` as `Witness.stop`'s."""
    if not still.size:
        return np.zeros(len(begin), dtype=bool)
    latest = np.maximum.accumulate(still[:, 1])
    last = np.searchsorted(still[:, 0], end, side="right") - 1
    return (last >= 0) & (latest[last] >= begin)
