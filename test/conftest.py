# SPDX-License-Identifier: Apache-2.0
"""Fixtures for every test: a ROS domain of its own, and real processes that cannot outlive it."""

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

import hypothesis
import pytest
from wheel_robot import WheelRobot

# Imported before numpy: as the executables do, tests leave linear algebra one thread.
import smp_motor_control.entry  # noqa: F401
from smp_motor_control.nodes import loopback

# Examples are drawn alike in every run, and may take their time on a busy machine.
hypothesis.settings.register_profile("suite", derandomize=True, deadline=None)
hypothesis.settings.load_profile("suite")

# Where the workspace's setup was sourced (colcon test), its executables are not on PATH.
for _prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
    _bin = Path(_prefix, "lib", "smp_motor_control")
    if _prefix and _bin.is_dir() and str(_bin) not in os.environ["PATH"].split(os.pathsep):
        os.environ["PATH"] = f"{_bin}{os.pathsep}{os.environ['PATH']}"


def pytest_configure(config: pytest.Config) -> None:
    """Add the filter whose name imports numpy, once it has one thread."""
    numpy_1 = "error::numpy.exceptions.VisibleDeprecationWarning"
    config.addinivalue_line("filterwarnings", numpy_1)


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


# A shell's background job and nohup ignore these; processes of tests must not inherit that.
for _number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
    if signal.getsignal(_number) is signal.SIG_IGN:
        _usual = signal.default_int_handler if _number == signal.SIGINT else signal.SIG_DFL
        signal.signal(_number, _usual)

BUSY = 60.0
"""Additional waiting time on a busy machine before a test gives up [s]."""


LIVE = ("nodes", "system")
"""Folders of tests of real processes in real time."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Give a test of real processes three tries: each is reported, and a defect fails them all.

    A pause of the machine at the wrong moment fails a test without a defect.
    """
    if config.pluginmanager.hasplugin("rerunfailures"):
        for item in items:
            if item.path.parent.name in LIVE:
                item.add_marker(pytest.mark.flaky(reruns=2))


@pytest.fixture(autouse=True)
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Give the test, and every process that it starts, a ROS domain of its own on loopback."""
    domain, handle = claim_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    for name, value in loopback.loopback_environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("ROS_STATIC_PEERS", raising=False)
    with handle:
        yield domain


class TestProcess:
    """A started executable: its output so far, and how to end it."""

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
        """Return the exit code; fail with the output if it does not come, however busy it is."""
        try:
            code = self._process.wait(timeout + BUSY)
        except subprocess.TimeoutExpired:
            pytest.fail(
                f"{self.command} still runs after {timeout + BUSY} s; its output:\n{self.output}"
            )
        self._reader.join(timeout=1.0)
        return code

    def end(self) -> None:
        """End whatever is left of the process group."""
        with contextlib.suppress(ProcessLookupError):
            if self.returncode is None:
                os.killpg(self.pid, signal.SIGINT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(3.0)
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()
        self._reader.join(timeout=1.0)


@pytest.fixture
def process(tmp_path: Path, ros_domain: int) -> Iterator[Callable[..., TestProcess]]:
    """Start executables as process groups: ``process("wheel_pid", "--ros-args", ...)``.

    Keywords ``env`` (added to the environment) and ``cwd`` (default: the test's temporary folder).
    All of them are ended when the test ends.
    """
    started: list[TestProcess] = []

    def start(*command, env=None, cwd=None):
        started.append(TestProcess([str(part) for part in command], env, cwd or tmp_path))
        return started[-1]

    yield start
    for one in reversed(started):
        one.end()


@pytest.fixture
def robot(ros_domain: int) -> Iterator[WheelRobot]:
    """Return a node that commands wheels and stores their states."""
    robot = WheelRobot(ros_domain)
    yield robot
    robot.close()


@pytest.fixture
def eventually() -> Callable[..., None]:
    """Poll until a condition holds: ``eventually(lambda: ..., deadline=5.0, step=node.spin)``.

    ``step`` is called between two looks (spin the node there); the default waits 10 ms.
    ``deadline`` is a free machine's, and a busy one gets ``BUSY`` more: a test of how soon
    something happens compares stamps instead.
    """

    def poll(condition, deadline=10.0, step=None, message=""):
        end = time.monotonic() + deadline + BUSY
        while not condition():
            if time.monotonic() > end:
                pytest.fail(f"not within {deadline + BUSY} s: {message or condition}")
            if step is None:
                time.sleep(0.01)
            else:
                step()

    return poll
