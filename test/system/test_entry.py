# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C in the first second: while an executable is still importing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from smp_motor_control import entry


def has_mapped(pid: int, library: str) -> bool:
    try:
        return library in Path(f"/proc/{pid}/maps").read_text()
    except FileNotFoundError:
        return False


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("wheel_pid --ros-args -r __ns:=/front_left", 0),
        ("skid_steer --ros-args -r __ns:=/front_left", 0),
        ("identify none.csv --output r", 130),
        ("tune none.json", 130),
    ],
)
def test_ctrl_c_while_importing_ends_without_a_traceback(process, eventually, command, code):
    started = process(*command.split())
    # numpy is among the first modules imported, and far from the last
    eventually(
        lambda: has_mapped(started.pid, "_multiarray_umath") or started.returncode is not None
    )
    assert started.returncode is None, started.output
    started.interrupt()
    # A tool may already have looked for its file, which is missing.
    assert started.wait(5.0) in (code, 2 if code else 0)
    assert "Traceback" not in started.output


@pytest.mark.parametrize("domain", ["9999", "-1", "first"])
@pytest.mark.parametrize("executable", ["wheel_pid", "record", "commission"])
def test_invalid_ros_domain_is_reported(process, executable, domain):
    arguments = ("--output", "r", "--yes") if executable == "commission" else ()
    started = process(executable, *arguments, env={"ROS_DOMAIN_ID": domain})
    assert started.wait(30.0) == 2
    (line,) = started.output.strip().splitlines()
    assert domain in line
    assert "0 to 232" in line


def test_linear_algebra_stays_on_one_thread():
    """Waiting for a second thread is a busy loop, which may never end at real-time priority."""
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}

    def threads(before: str) -> int:
        program = (
            f"import os\n{before}\nimport numpy, scipy.linalg\n"
            "scipy.linalg.expm(numpy.eye(300))\n"
            "print(len(os.listdir('/proc/self/task')))\n"
        )
        command = [sys.executable, "-c", program]
        shown = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return int(shown.stdout)

    if threads("") == 1:
        pytest.skip("this machine's linear algebra has one thread anyway")
    assert threads("import smp_motor_control.entry") == 1


def test_missing_package_is_reported_with_its_install_command(process, tmp_path):
    (tmp_path / "numba.py").write_text("raise ModuleNotFoundError(name='numba')\n")
    for executable in ("identify", "tune", "identifier"):
        path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
        started = process(executable, "--force", "x.csv", env={"PYTHONPATH": path})
        assert started.wait(20.0) == 2
        assert "pip install numba" in started.output
        assert "Traceback" not in started.output


def test_pip_advice_has_break_system_packages_in_managed_environment(monkeypatch, tmp_path):
    monkeypatch.setattr("sysconfig.get_path", lambda name: str(tmp_path))
    absent = ModuleNotFoundError(name="mcap")
    monkeypatch.setattr(sys, "prefix", sys.base_prefix)
    assert entry.explain_missing_module(absent).endswith("pip install mcap")
    (tmp_path / "EXTERNALLY-MANAGED").touch()
    assert entry.explain_missing_module(absent).endswith("pip install --break-system-packages mcap")


@pytest.mark.parametrize("executable", ["wheel_pid", "skid_steer", "excite", "identifier", "play"])
def test_every_node_has_help(process, executable):
    started = process(executable, "--help")
    assert started.wait(30.0) == 0
    assert f"usage: {executable}" in started.output


def test_import_error_caused_by_ctrl_c_is_treated_as_ctrl_c(monkeypatch):
    def was_interrupted_on_import(module: str) -> None:
        try:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt as stop:
                raise ImportError("initialization failed") from stop
        except ImportError:
            raise ImportError(f"the C extension of {module} is not present")  # noqa: B904

    monkeypatch.setattr(entry.importlib, "import_module", was_interrupted_on_import)
    assert entry._make_program("smp_motor_control.nodes.wheel_pid", 0)() == 0
    assert entry._make_program("smp_motor_ident.cli.tune", 130)() == 130

    def broken(module: str) -> None:
        raise ImportError("undefined symbol")

    monkeypatch.setattr(entry.importlib, "import_module", broken)
    with pytest.raises(ImportError, match="undefined symbol"):
        entry._make_program("smp_motor_control.nodes.wheel_pid", 0)()


def test_ctrl_c_ignored_by_python_during_import_still_ends_a_node(process, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(
        "import os, signal, sys\n"
        "class Dropped:\n"
        "    def __del__(self):\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'smp_motor_control.nodes.runtime':\n"
        "            Dropped()\n"
        "sys.meta_path.insert(0, Finder())\n"
    )
    path = os.pathsep.join([str(tmp_path), os.environ["PYTHONPATH"]])
    started = process("skid_steer", "--ros-args", env={"PYTHONPATH": path})
    assert started.wait(30.0) == 0
    assert "KeyboardInterrupt" in started.output  # Python's report of ignored exceptions
