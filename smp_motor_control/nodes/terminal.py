"""A terminal that gives single keys, and is itself again whatever happens."""

import atexit
import contextlib
import os
import select
import shutil
import signal
import sys
import termios
import tty
from collections.abc import Callable
from types import FrameType

from smp_motor_control.errors import SmpError

_HIDE_CURSOR, _SHOW_CURSOR = "\x1b[?25l", "\x1b[?25h"


class Terminal:
    """The controlling terminal with keys unechoed and unbuffered.

    ``suspend`` is called before Ctrl-Z suspends the process, ``leave`` when the terminal is gone,
    and ``resume`` after the process was continued.
    """

    def __init__(
        self, suspend: Callable[[], None], leave: Callable[[], None], resume: Callable[[], None]
    ) -> None:
        if not sys.stdin.isatty():
            raise SmpError("standard input is not a terminal: start it in a terminal of its own")
        if in_background(sys.stdin.fileno()):
            raise SmpError("runs in the background of its terminal: start it in the foreground")
        self._fd = sys.stdin.fileno()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        self._usual = termios.tcgetattr(self._fd)
        self._suspend, self._leave, self._resume = suspend, leave, resume
        self._ours = False
        atexit.register(self.restore)
        self.take()
        signal.signal(signal.SIGTSTP, self._on_suspend)
        signal.signal(signal.SIGCONT, self._on_continue)

    def take(self) -> None:
        """Get keys one by one from now on."""
        tty.setcbreak(self._fd)
        self._ours = True
        self.write(_HIDE_CURSOR)

    def restore(self) -> None:
        """Give the terminal back as it was; as often as wanted."""
        if not self._ours:
            return
        self._ours = False
        # A terminal that is gone needs nothing.
        with contextlib.suppress(termios.error, OSError, ValueError):
            termios.tcsetattr(self._fd, termios.TCSANOW, self._usual)
            self.write(_SHOW_CURSOR + "\r\n")

    def read(self) -> str:
        """Return what was typed since the last call; leaves when the terminal is gone."""
        events = dict(self._poll.poll(0)).get(self._fd, 0)
        if events & ~select.POLLIN:  # hung up
            self._leave()
        if not events & select.POLLIN:
            return ""
        try:
            return os.read(self._fd, 1024).decode(errors="ignore")
        except OSError:
            self._leave()
            return ""

    def write(self, text: str) -> None:
        """Write at once."""
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.write(text)
            sys.stdout.flush()

    def write_status(self, text: str) -> None:
        """Replace the line that the cursor is in."""
        width = shutil.get_terminal_size().columns
        self.write(f"\r{text[: width - 1]}\x1b[K")

    def _on_suspend(self, number: int, frame: FrameType | None) -> None:
        self._suspend()
        self.restore()
        os.kill(os.getpid(), signal.SIGSTOP)

    def _on_continue(self, number: int, frame: FrameType | None) -> None:
        if in_background(self._fd):
            return  # continued by `bg`: it stays silent until it is in the foreground
        if not self._ours:
            self.take()
        self._resume()


def in_background(fd: int) -> bool:
    """Tell whether another process group has the terminal."""
    return os.tcgetpgrp(fd) != os.getpgrp()
