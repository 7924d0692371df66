# SPDX-License-Identifier: Apache-2.0
"""Start nodes as separate processes, and stop all of them at the end."""

import contextlib
import fcntl
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from smp_motor_control.entry import find_domain_problem
from smp_motor_control.errors import SmpError
from smp_motor_control.motor.file import find_config
from smp_motor_ident.cli import interruption, workers
from smp_motor_ident.errors import ParameterError

FREE_DOMAINS = range(215, 233)  # ROS domains for simulated robots
FAST_DDS = "rmw_fastrtps"  # jazzy's default middleware, for which the loopback profile is written


class ProcessError(SmpError):
    """A node ended by itself or does not respond."""

    exit_code = 1


@contextlib.contextmanager
def connect(name: str, ros_arguments: Sequence[str] = ()) -> Iterator[Any]:
    """Yield the client of a running robot; ROS is imported only now.

    Ctrl-Z interrupts the block like Ctrl-C: a suspended tool could not stop the wheels.
    """
    if wrong := find_domain_problem():
        raise ParameterError(wrong)
    try:
        from smp_motor_control.nodes.robot_client import RobotClient
    except ImportError as error:
        raise ParameterError(
            f"a running robot needs ROS, and {error.name or error} is missing; source the "
            "workspace, or setup.bash of the repository"
        ) from None
    with interruption.interruptible(signal.SIGTSTP), RobotClient(ros_arguments, name) as client:
        yield client


def isolate(domain: int | None) -> int:
    """Restrict ROS to this computer and a domain, by default a free one; return the domain."""
    chosen = _find_free_domain() if domain is None else domain
    os.environ.update({"ROS_DOMAIN_ID": str(chosen), **loopback_environment()})
    return chosen


def loopback_environment() -> dict[str, str]:
    """Return variables that restrict discovery and sockets to this computer.

    ROS's range LOCALHOST restricts discovery only; Fast DDS needs the profile to bind to loopback.
    """
    if not os.environ.get("RMW_IMPLEMENTATION", FAST_DDS).startswith(FAST_DDS):
        return {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(find_config("loopback.xml")),
    }


def _find_free_domain() -> int:
    """Claim a ROS domain that is unused on this machine, until this process ends.

    References
    ----------
    DDSI-RTPS 2.5, section 9.6.1.1: port 7400 + 250 domain + 10 belongs to participant 0.
    """
    for k in range(len(FREE_DOMAINS)):
        domain = FREE_DOMAINS[(os.getpid() + k) % len(FREE_DOMAINS)]
        if not _claim(domain):
            continue
        probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with probe, contextlib.suppress(OSError):
            probe.bind(("", 7400 + 250 * domain + 10))
            return domain
    first, last = FREE_DOMAINS[0], FREE_DOMAINS[-1]
    raise ProcessError(f"all ROS domains from {first} to {last} are in use; end one of their users")


_CLAIMS: list[IO[str]] = []


def _claim(domain: int) -> bool:
    """Lock the domain's file; the lock ends with this process."""
    path = Path(tempfile.gettempdir()) / f"smp_domain_{domain}_{os.getuid()}.lock"
    claim = path.open("w")
    try:
        fcntl.flock(claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        claim.close()
        return False
    _CLAIMS.append(claim)
    return True


class Processes:
    """A set of node processes that ends with its ``with`` block in any case.

    Each leads its own process group and is stopped by SIGINT, then SIGTERM, then SIGKILL; the
    kernel sends it SIGTERM if this process dies.  Its output goes to its own
    ``NAME.log``.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> "Processes":
        """Begin."""
        self._logs.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop all; a second Ctrl-C does not interrupt this."""
        ignored = (signal.SIGINT, signal.SIGTERM, signal.SIGTSTP)
        kept = {s: signal.signal(s, signal.SIG_IGN) for s in ignored}
        try:
            self.stop(*self._running)
        finally:
            for number, handler in kept.items():
                signal.signal(number, handler)

    def start(self, name: str, node: str, *arguments: str, priority: int = 0) -> None:
        """Start a node or a tool with a real-time priority or, below 0, with a niceness."""
        self._logs.mkdir(parents=True, exist_ok=True)
        parent = os.getpid()
        with (self._logs / f"{name}.log").open("wb") as log, interruption.delayed():
            self._running[name] = subprocess.Popen(
                [*_command(node), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
                start_new_session=True,
                preexec_fn=lambda: _prepare(parent, priority),
            )

    def check(self, but: str = "") -> None:
        """Check that all are still running."""
        interruption.check()
        for name, process in self._running.items():
            if name != but and process.poll() is not None:
                raise ProcessError(
                    f"{name} ended with exit code {process.returncode}: {self.last_line(name)} "
                    f"(log: {self._logs / f'{name}.log'})"
                )

    def wait(self, name: str, timeout: float) -> None:
        """Wait for a process that ends by itself."""
        process = self._running[name]
        deadline = time.monotonic() + timeout
        while process.poll() is None:
            if time.monotonic() > deadline:
                raise ProcessError(f"{name} is not done after {timeout:.0f} s")
            self.check(but=name)
            time.sleep(0.05)
        if process.returncode != 0:
            self.check()
        del self._running[name]

    def has_ended(self, name: str) -> bool:
        """Return whether a process has ended."""
        return name not in self._running or self._running[name].poll() is not None

    def interrupt(self, name: str) -> None:
        """Ask a process to stop, without waiting for it."""
        if name in self._running:
            _signal(self._running[name], signal.SIGINT)

    def last_line(self, name: str) -> str:
        """Return the last line that a process has printed."""
        log = self._logs / f"{name}.log"
        lines = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
        return lines[-1] if lines else "no output"

    def stop(self, *names: str) -> None:
        """Stop processes together, by stronger signals in turn."""
        group = [self._running.pop(name) for name in names if name in self._running]
        for number, patience in ((signal.SIGINT, 5.0), (signal.SIGTERM, 2.0), (signal.SIGKILL, 5)):
            for process in group:
                _signal(process, number)
            deadline = time.monotonic() + patience
            while (alive := any(p.poll() is None for p in group)) and time.monotonic() < deadline:
                time.sleep(0.02)
            if not alive:
                break
        for process in group:
            _signal(process, signal.SIGKILL)  # children that a node left in its group


def _command(node: str) -> list[str]:
    """Return the command of a node: its installed executable or, without one, its entry point."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        executable = Path(prefix) / "lib" / "smp_motor_control" / node
        if prefix and executable.is_file():
            return [str(executable)]
    start = f"import sys; from smp_motor_control.entry import {node}; sys.exit({node}())"
    return [sys.executable, "-c", start]


def _prepare(parent: int, priority: int) -> None:
    """Prepare a forked process before exec: it ends when ``parent`` dies."""
    workers.die_with_parent(signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(1)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)  # a shell's background job ignores SIGINT
    if priority < 0:
        os.nice(-priority)
    elif priority:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))


def _signal(process: subprocess.Popen[bytes], number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
