# SPDX-License-Identifier: Apache-2.0
"""Fixtures for every test: a ROS domain of its own, and real processes that cannot outlive it."""

# Imported before numpy: as the executables do, tests leave linear algebra one thread.
import smp_motor_control.entry  # noqa: F401

# isort: split
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest
from browser import CHROMIUM, Browser
from processes import BUSY, TestProcess, own_domain, processes
from wheel_robot import WheelRobot

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


# A shell's background job and nohup ignore these; processes of tests must not inherit that.
for _number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
    if signal.getsignal(_number) is signal.SIG_IGN:
        _usual = signal.default_int_handler if _number == signal.SIGINT else signal.SIG_DFL
        signal.signal(_number, _usual)

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
def ros_domain() -> Iterator[int]:
    """Give the test a ROS domain of its own."""
    with own_domain() as domain:
        yield domain


@pytest.fixture
def process(tmp_path: Path, ros_domain: int) -> Iterator[Callable[..., TestProcess]]:
    """Start executables in the test's temporary folder, and end them with the test."""
    with processes(tmp_path) as start:
        yield start


@pytest.fixture
def robot(ros_domain: int) -> Iterator[WheelRobot]:
    """Return a node that commands wheels and stores their states."""
    robot = WheelRobot(ros_domain)
    yield robot
    robot.close()


@pytest.fixture(scope="module")
def opened_browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if not CHROMIUM:
        pytest.skip("no Chromium on this machine")
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture
def browser(opened_browser: Browser) -> Browser:
    """Return the browser of the test's file, without complaints or requests so far."""
    opened_browser.complaints.clear()
    opened_browser.requests.clear()
    return opened_browser


@pytest.fixture(scope="session")
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
