"""Gives back what a tool took from a running robot, when the tool was killed.

The tool writes what it owes, a line of JSON each time it changes.  The guard is a process of a
session of its own, so that what ends the tool does not end it: when its standard input ends and
the last line is not empty, it activates the controllers and sets the gains that stand there.
"""

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

TRY_FOR = 20.0  # how long a robot is asked to take back what is its own [s]


class Guard:
    """The tool's end of the guard, which joins the graph by the tool's ROS arguments."""

    def __init__(self, arguments: Sequence[str]) -> None:
        command, nowhere = [sys.executable, "-m", __name__, *arguments], subprocess.DEVNULL
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=nowhere, stderr=nowhere, text=True,
            start_new_session=True,
        )  # fmt: skip

    def note(self, owed: Mapping[str, Any]) -> None:
        """Replace what is owed."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(owed) + "\n")
            self._process.stdin.flush()

    def close(self) -> None:
        """Leave the rest, if there is any, to the guard."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(3.0)


def main() -> int:
    """Wait for the tool's end, and give back what it owes then."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    from smp_motor_control.errors import SmpError
    from smp_motor_control.nodes.robot_client import RobotClient

    with RobotClient(sys.argv[1:], "robot_guard", guarded=False) as client:
        owed: dict[str, Any] = {}
        for line in sys.stdin:
            if line.endswith("\n"):
                owed = json.loads(line)
        end = time.monotonic() + TRY_FOR
        while owed and time.monotonic() < end:
            with contextlib.suppress(SmpError):
                client.give_back(owed)
                owed = {}
    return 1 if owed else 0


if __name__ == "__main__":
    sys.exit(main())
