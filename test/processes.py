# SPDX-License-Identifier: Apache-2.0
"""ROS domains of tests, and real processes that cannot outlive them."""

import contextlib
import fcntl
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO

import pytest

from smp_motor_ident.cli.processes import loopback_environment

BUSY = 60.0
"""Additional waiting time on a busy machine before a test gives up [s]."""

# DDS derives UDP ports from the domain; up to 101 they stay below those that Linux hands out.
DOMAINS = range(1, 102)


def claim_domain() -> tuple[int, IO[str]]:
    """Claim a ROS domain id that no other test on this machine holds, until the file is closed."""
    folder = Path(tempfile.gettempdir()) / f"smp_test_domains_{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    # Start at different ids: a domain rests between two tests, so late datagrams find no one.
    start = time.monotonic_ns() // 1_000_000 % len(DOMAINS)
    for offset in range(len(DOMAINS)):
        domain = DOMAINS[(start + offset) % len(DOMAINS)]
        handle = (folder / str(domain)).open("w", encoding="ascii")
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            handle.close()
            continue
        return domain, handle
    raise RuntimeError(f"all ROS domains {DOMAINS[0]} to {DOMAINS[-1]} are in use")


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """Give this process, and every one that it starts, a ROS domain of its own on loopback."""
    domain, handle = claim_domain()
    with handle, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        for name, value in loopback_environment().items():
            patch.setenv(name, value)
        patch.delenv("ROS_STATIC_PEERS", raising=False)
        yield domain


class TestProcess:
    """A started executable and its output so far."""

    __test__ = False

    def __init__(self, command: Sequence[str], env: dict[str, str] | None, cwd: Path) -> None:
        self.command = tuple(str(part) for part in command)
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", **(env or {})}
        self._process = subprocess.Popen(
            self.command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=environment,
            cwd=cwd,
            start_new_session=True,
        )
        self.pid = self._process.pid
        self._lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.append(line)

    @property
    def output(self) -> str:
        """Standard output and error so far."""
        return "".join(self._lines)

    @property
    def returncode(self) -> int | None:
        """Exit code, or None while it runs."""
        return self._process.poll()

    def send_signal(self, number: int) -> None:
        """Send a signal to the process alone, as a supervisor does."""
        if self.returncode is None:
            os.kill(self.pid, number)

    def interrupt(self) -> None:
        """Send SIGINT to the whole group, as Ctrl-C in a terminal does."""
        if self.returncode is None:
            os.killpg(self.pid, signal.SIGINT)

    def wait(self, timeout: float) -> int:
        """Return the exit code; fail with the output after the time-out."""
        try:
            code = self._process.wait(timeout + BUSY)
        except subprocess.TimeoutExpired:
            pytest.fail(
                f"{self.command} still runs after {timeout + BUSY} s; its output:\n{self.output}"
            )
        self._reader.join(timeout=1.0)
        return code

    def end(self) -> None:
        """End all remaining processes of the group."""
        with contextlib.suppress(ProcessLookupError):
            if self.returncode is None:
                os.killpg(self.pid, signal.SIGINT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(3.0)
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()
        self._reader.join(timeout=1.0)


@contextlib.contextmanager
def processes(folder: Path) -> Iterator[Callable[..., TestProcess]]:
    """Start executables as process groups: ``process("wheel_pid", "--ros-args", ...)``.

    Keywords ``env`` (added to the environment) and ``cwd`` (default: ``folder``).
    All of them are ended at the end.
    """
    started: list[TestProcess] = []

    def start(*command, env=None, cwd=None):
        started.append(TestProcess([str(part) for part in command], env, cwd or folder))
        return started[-1]

    yield start
    for one in reversed(started):
        one.end()
