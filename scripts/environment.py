# SPDX-License-Identifier: Apache-2.0
"""Prepare the environment in two stages, each redone only when its inputs change.

1. ``.venv``: the pinned packages; with ROS 2 Jazzy sourced only those that ROS lacks.
2. ``install``: messages, executables, launch files and configuration, as links into the source.

Only the standard library is used: this runs before anything is installed.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
READY = VENV / "ready"  # exists only while everything is in place; its first line is the ROS prefix
STAMPS = VENV / "stamps.json"
LOG = VENV / "setup.log"
PYTHON = str(getattr(sys, "_base_executable", sys.executable))  # not that of a virtual environment
LAYOUT = "2"  # to be raised when this file prepares something in another way
CXX = ["c++", "g++", "clang++"]
APT = ["numpy", "scipy", "matplotlib", "yaml"]  # left to apt where ROS is installed
FOREIGN = {
    *("PYTHONHOME", "VIRTUAL_ENV", "PIP_USER", "PIP_TARGET", "PIP_PREFIX", "PIP_CONSTRAINT"),
    *("PIP_REQUIRE_VIRTUALENV", "PIP_NO_BINARY"),
    *("COLCON_PREFIX_PATH", "COLCON_HOME", "COLCON_DEFAULTS_FILE"),
}
FOREIGN_TO_WHEELS = {
    *("PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"),
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
}
NETWORK = re.compile(
    r"NewConnectionError|NameResolutionError|ConnectTimeout|ReadTimeout|ProxyError|Retrying \("
    r"|Temporary failure in name resolution|Network is unreachable|SSLError"
)


class SetupError(Exception):
    """Why the environment cannot be prepared, and what to do, in one line."""


def say(text: str) -> None:
    print(f"setup: {text}", flush=True)


def find_ros() -> str:
    """Return the prefix of a sourced ROS 2 Jazzy, or '' where the wheels are to be used."""
    distro = os.environ.get("ROS_DISTRO", "")
    if not distro:
        return ""
    if distro != "jazzy":
        raise SetupError(
            f"ROS 2 {distro} is sourced, but this package needs Jazzy: in a new shell source"
            " /opt/ros/jazzy/setup.bash, or nothing of ROS"
        )
    for entry in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        prefix = Path(entry)
        if entry and ROOT not in prefix.parents and (prefix / "share/rclpy/package.xml").is_file():
            break
    else:
        raise SetupError(
            "ROS_DISTRO=jazzy is set, but no folder of AMENT_PREFIX_PATH holds rclpy:"
            " source /opt/ros/jazzy/setup.bash, or unset ROS_DISTRO to use the wheels"
        )
    for names, advice in (
        (["rclpy"], "name the Python that ROS was built for (make setup PYTHON=/usr/bin/python3)"),
        (APT, "apt install " + " ".join(f"python3-{name}" for name in APT)),
    ):
        code = f"import {', '.join(names)}"
        if subprocess.run([PYTHON, "-c", code], capture_output=True, check=False).returncode:
            raise SetupError(f"{PYTHON} cannot {code} with the ROS of {prefix}: {advice}")
    return str(prefix)


def check_machine(ros: str) -> None:
    """Raise `SetupError` for missing tools that pip and colcon report late."""
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise SetupError(
            f"{sys.executable} has no venv module: install it (apt install python{version}-venv)"
        ) from None
    if not ros and not os.confstr("CS_GNU_LIBC_VERSION"):
        raise SetupError("the ROS wheels need a Linux with glibc (Debian, Ubuntu, Fedora, ...)")
    wanted = {
        "a C compiler (cc, gcc or clang)": [os.environ.get("CC", ""), "cc", "gcc", "clang"],
        "a C++ compiler (c++, g++ or clang++)": [os.environ.get("CXX", ""), *CXX],
        "cmake": ["cmake"],
        "make": ["make"],
    }
    missing = [
        name
        for name, commands in wanted.items()
        if not any(shutil.which(command.split()[0]) for command in commands if command)
    ]
    if missing:
        raise SetupError(
            f"{', '.join(missing)} not found: install the build tools"
            " (Debian, Ubuntu: apt install build-essential cmake)"
        )
    header = Path(sysconfig.get_path("include")) / "Python.h"
    if not header.is_file():
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise SetupError(f"{header} not found: install it (apt install python{version}-dev)")


def fingerprint(*parts: str, files: Iterable[Path] = (), names: Iterable[Path] = ()) -> str:
    """Return a hash over texts, over the contents of files and over the names of others."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.encode() + b"\0")
    for path in sorted(files):
        digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    for path in sorted(names):
        digest.update(str(path.relative_to(ROOT)).encode() + b"\0")
    return digest.hexdigest()


def stage_keys(ros: str) -> dict[str, str]:
    """Return a key for each stage over all its inputs."""
    python = fingerprint(LAYOUT, str(ROOT), sys.version, os.path.realpath(PYTHON), ros)
    packages = fingerprint(python, files=[requirements(ros)])
    package = fingerprint(
        python,
        *(line for line in requirements(ros).read_text().splitlines() if line.startswith("ros")),
        files=[
            *(path for path in (ROOT / "smp_interfaces").rglob("*") if path.is_file()),
            *(ROOT / name for name in ("setup.py", "setup.cfg", "package.xml")),
        ],
        names=[*ROOT.glob("launch/*"), *ROOT.glob("config/*"), *ROOT.glob("resource/*")],
    )
    return {"python": python, "packages": packages, "package": package}


def requirements(ros: str) -> Path:
    return ROOT / "requirements" / ("jazzy.txt" if ros else "wheels.txt")


def environment(ros: str) -> dict[str, str]:
    """Return the environment for pip, CMake and colcon, without another Python or ROS."""
    foreign = FOREIGN if ros else FOREIGN | FOREIGN_TO_WHEELS
    env = {name: value for name, value in os.environ.items() if name not in foreign}
    env["PATH"] = f"{VENV}/bin{os.pathsep}{env['PATH']}"
    if not ros:
        env["AMENT_PREFIX_PATH"] = env["CMAKE_PREFIX_PATH"] = str(VENV)
    return env


def run(command: list[str], env: dict[str, str], lock: IO[str], count: str = "") -> None:
    """Run a command with its output in the log; show how many of its lines begin with `count`."""
    with LOG.open("a", encoding="utf-8") as log:
        log.write(f"\n$ {' '.join(command)}\n")
        log.flush()
        # The lock is passed on: it is held until the last of the command's processes has ended.
        with subprocess.Popen(
            command,
            cwd=ROOT,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            pass_fds=(lock.fileno(),),
        ) as process:
            assert process.stdout is not None
            seen, lines, shown = 0, [], time.monotonic()
            for line in process.stdout:
                log.write(line)
                lines.append(line)
                seen += bool(count) and line.startswith(count)
                if count and time.monotonic() - shown > 5.0:
                    say(f"      {seen} so far")
                    shown = time.monotonic()
    if process.returncode:
        text = "".join(lines)
        if "pip" in command and NETWORK.search(text):
            raise SetupError(
                "the Python package index cannot be reached: connect to the network (or set"
                f" PIP_INDEX_URL to a mirror) and run it again; details in {LOG}"
            )
        reasons = [line for line in lines if re.search(r"(?i)\berror\b", line)] or lines[-1:]
        reason = reasons[0].strip() if reasons else f"exit code {process.returncode}"
        raise SetupError(f"{Path(command[0]).name} failed: {reason}; details in {LOG}")


def make_venv(ros: str, lock: IO[str]) -> None:
    for folder in (VENV, ROOT / "build", ROOT / "install"):
        shutil.rmtree(folder, ignore_errors=True)
    VENV.mkdir()
    (VENV / "COLCON_IGNORE").touch()
    options = ["--system-site-packages"] if ros else []
    run([PYTHON, "-m", "venv", *options, str(VENV)], environment(ros), lock)


def install_packages(ros: str, lock: IO[str]) -> None:
    """Install the lock file, which has every transitive dependency with its hashes."""
    lockfile = requirements(ros)
    options = ["--no-deps", "--no-input", "--disable-pip-version-check", "--progress-bar=off"]
    options.append("--require-hashes")
    run(
        [f"{VENV}/bin/python", "-m", "pip", "install", *options, "-r", str(lockfile)],
        environment(ros),
        lock,
        count="Collecting ",
    )
    if not ros:
        patch_cmake_files(environment(ros))


def patch_cmake_files(env: dict[str, str]) -> None:
    """Replace the paths of the machine that built the wheels by those of this one."""
    query = (
        "import numpy, sysconfig; print(sysconfig.get_path('include')); print(numpy.get_include())"
    )
    answer = subprocess.run(
        [f"{VENV}/bin/python", "-c", query], env=env, capture_output=True, text=True, check=True
    )
    python_include, numpy_include = answer.stdout.splitlines()
    built = rb"/opt/python/cp3\d+-cp3\d+/"
    for path in (VENV / "share").rglob("*"):
        if not path.is_file() or path.is_symlink():
            continue
        old = path.read_bytes()
        new = re.sub(built + rb"include/python3\.\d+", python_include.encode(), old)
        numpy = rb"lib/python3\.\d+/site-packages/numpy/_core/include"
        new = re.sub(built + numpy, numpy_include.encode(), new)
        if new != old:
            path.write_bytes(new)


def build(ros: str, lock: IO[str]) -> None:
    """Build the package and its messages; Python and data files become links into the source."""
    command = [f"{VENV}/bin/python", "-m", "colcon", "build", "--symlink-install"]
    command += ["--event-handlers", "console_direct+"]
    run(command, environment(ros), lock)
    for path in (ROOT / "install").rglob("*"):
        if path.is_symlink() and not path.exists():
            path.unlink()  # its source is gone


def verify(ros: str, lock: IO[str]) -> None:
    """Import the built packages in the shell of setup.bash."""
    script = (
        ". install/local_setup.bash && exec .venv/bin/python -c"
        " 'import rclpy, rosbags, control, numba; from smp_interfaces.msg import MotorState'"
    )
    run(["bash", "-c", script], environment(ros), lock)


def prepare(lock: IO[str]) -> bool:
    """Redo the stages whose inputs changed; return whether there were any."""
    ros = find_ros()
    keys = stage_keys(ros)
    try:
        done = json.loads(STAMPS.read_text())
    except (OSError, ValueError):
        done = {}
    installed = ROOT / "install" / "smp_motor_control" / "share"
    if not all((installed / name).exists() for name in ("smp_motor_control", "smp_interfaces")):
        done.pop("package", None)  # someone cleaned the workspace as one does with colcon
    if READY.is_file() and done == keys:
        return False
    check_machine(ros)
    READY.unlink(missing_ok=True)
    version = ".".join(map(str, sys.version_info[:3]))
    stages: dict[str, tuple[str, Callable[[], None]]] = {
        "python": (f"Python {version} in .venv", lambda: make_venv(ros, lock)),
        "packages": (
            f"the packages of {requirements(ros).relative_to(ROOT)} (about a minute)",
            lambda: install_packages(ros, lock),
        ),
        "package": (
            "messages and executables, compiled for this machine (a minute)",
            lambda: build(ros, lock),
        ),
    }
    say(f"with ROS 2 of {ros}" if ros else "without ROS: real rclpy and DDS from wheels")
    for number, (stage, (title, work)) in enumerate(stages.items(), start=1):
        if done.get(stage) == keys[stage]:
            continue
        if stage == "python":
            done = {}
        say(f"{number}/{len(stages)}   {title}")
        done.pop(stage, None)
        if VENV.is_dir():
            write(STAMPS, json.dumps(done))
        work()
        done[stage] = keys[stage]
        write(STAMPS, json.dumps(done))
    verify(ros, lock)
    write(READY, f"{ros}\n")
    return True


def write(path: Path, text: str) -> None:
    """Replace a file atomically."""
    partial = path.with_suffix(".partial")
    partial.write_text(text)
    partial.replace(path)


def interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def main() -> int:
    signal.signal(signal.SIGTERM, interrupt)
    started = time.monotonic()
    with (ROOT / ".setup.lock").open("w", encoding="ascii") as lock:
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                say("another set-up is running here; waiting for it")
                fcntl.flock(lock, fcntl.LOCK_EX)
            if prepare(lock):
                say(f"done in {time.monotonic() - started:.0f} s; for a shell: . ./setup.bash")
        except SetupError as error:
            print(f"setup: {error}", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            print("setup: interrupted; `make setup` goes on where it stopped", file=sys.stderr)
            return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
