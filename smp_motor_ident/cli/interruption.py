# SPDX-License-Identifier: Apache-2.0
"""Handle Ctrl-C reliably: store it when it comes, and raise it again where a tool waits.

Python drops an exception that a signal handler raises inside some callbacks, such as those around a
fork; a tool that is just starting a process would then ignore it.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_requested = threading.Event()
_delayed = threading.Event()


@contextmanager
def interruptible(*more: signal.Signals) -> Iterator[None]:
    """Let SIGINT, SIGTERM, SIGHUP and ``more`` signals interrupt the block."""
    previous = {number: signal.signal(number, _interrupt) for number in (*_SIGNALS, *more)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        if previous[signal.SIGINT] is not _interrupt:
            _requested.clear()


def check() -> None:
    """Raise a pending interruption that Python has dropped."""
    if _requested.is_set():
        raise KeyboardInterrupt


@contextmanager
def delayed() -> Iterator[None]:
    """Delay interruptions until the end of the block."""
    _delayed.set()
    try:
        yield
    finally:
        _delayed.clear()
    check()


def _interrupt(number: int, frame: FrameType | None) -> None:
    if number == signal.SIGTSTP:
        os.killpg(0, signal.SIGCONT)  # Ctrl-Z suspends this tool's helper processes
    _requested.set()
    if not _delayed.is_set():
        raise KeyboardInterrupt
