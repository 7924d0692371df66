# SPDX-License-Identifier: Apache-2.0
"""Restores a robot's controllers and gains when a tool is killed.

The tool writes the state to restore as a line of JSON whenever it changes.  The guard runs in a
session of its own, so that it survives the tool: at the end of its input it activates the
controllers and sets the gains of the last line.
"""

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

RETRY_TIME_S = 20.0


class Guard:
    """The tool's end of the guard."""

    def __init__(self, arguments: Sequence[str]) -> None:
        command, nowhere = [sys.executable, "-m", __name__, *arguments], subprocess.DEVNULL
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=nowhere, stderr=nowhere, text=True,
            start_new_session=True,
        )  # fmt: skip

    def note(self, pending_restore: Mapping[str, Any]) -> None:
        """Replace the state to restore."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(pending_restore) + "\n")
            self._process.stdin.flush()

    def close(self) -> None:
        """End the guard's input; it restores any pending state."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(3.0)


def main() -> int:
    """Wait for the tool's end and restore the pending state."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    from smp_motor_control.errors import SmpError
    from smp_motor_control.nodes.robot_client import RobotClient

    with RobotClient(sys.argv[1:], "robot_guard", guarded=False) as client:
        pending_restore: dict[str, Any] = {}
        for line in sys.stdin:
            if line.endswith("\n"):
                pending_restore = json.loads(line)
                client.prepare(pending_restore)
        end = time.monotonic() + RETRY_TIME_S
        while pending_restore and time.monotonic() < end:
            with contextlib.suppress(SmpError):
                client.restore(pending_restore)
                pending_restore = {}
    return 1 if pending_restore else 0


if __name__ == "__main__":
    sys.exit(main())
