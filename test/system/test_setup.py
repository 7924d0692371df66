# SPDX-License-Identifier: Apache-2.0
"""The set-up of a clone, its built packages, and the guards of `make check`."""

import fcntl
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
INPUTS = ["scripts", "requirements", "smp_interfaces", "resource", "setup.py", "setup.cfg"]
INPUTS += ["package.xml", "setup.bash"]
BASE = str(getattr(sys, "_base_executable", sys.executable))
# The ROS of the shell that runs the tests, if there is one.
OF_ROS = ("ROS_DISTRO", "AMENT_PREFIX_PATH", "PYTHONPATH", "LD_LIBRARY_PATH")
ROS = {name: os.environ[name] for name in OF_ROS if name in os.environ}
# Commands that the script itself calls, without the tools that it has to find.
SHELL_TOOLS = ("sh", "bash", "dirname", "uname", "env")


@pytest.fixture
def clone(tmp_path):
    """A copy of the files that the set-up reads, in which nothing is set up."""
    folder = tmp_path / "clone"
    folder.mkdir()
    for name in INPUTS:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name)
        else:
            shutil.copy2(ROOT / name, folder / name)
    return folder


@pytest.fixture
def machine(tmp_path):
    """A folder for PATH that holds little more than a shell."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in SHELL_TOOLS:
        found = shutil.which(tool)
        assert found
        (folder / tool).symlink_to(found)
    return folder


def run(clone, path, *, command=("scripts/setup.sh",), **extra):
    return subprocess.run(
        command,
        cwd=clone,
        env={"PATH": str(path), "HOME": str(clone), **extra},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def assert_refused(result, clone, *words):
    """Assert that stderr is one line with the words, and that nothing counts as set up."""
    assert result.returncode == 1
    assert result.stderr.count("\n") == 1, result.stderr
    for word in words:
        assert word in result.stderr
    assert not (clone / ".venv" / "ready").exists()


def test_missing_python_is_reported_with_the_package_to_install(clone, machine):
    assert_refused(run(clone, machine), clone, "no Python 3.10 to 3.13", "apt install python3")


def test_invalid_python_executable_is_reported(clone, machine):
    false = shutil.which("false")
    assert_refused(run(clone, machine, PYTHON=false), clone, false, "not a Python 3.10 to 3.13")


def test_unsupported_processor_is_reported(clone, machine):
    (machine / "uname").unlink()
    (machine / "uname").write_text('#!/bin/sh\n[ "$1" = -s ] && echo Linux || echo aarch64\n')
    (machine / "uname").chmod(0o755)
    assert_refused(run(clone, machine), clone, "Linux on aarch64 is not supported", "x86_64")


def test_all_missing_build_tools_are_reported_at_once(clone, machine):
    result = run(clone, machine, PYTHON=BASE)
    assert_refused(result, clone, "C compiler", "C++ compiler", "cmake", "make", "apt install")
    assert not (clone / ".venv").exists()


def test_another_ros_distribution_is_refused(clone):
    result = run(clone, os.environ["PATH"], PYTHON=BASE, ROS_DISTRO="humble")
    assert_refused(result, clone, "humble", "Jazzy")


def test_partially_sourced_ros_is_refused(clone):
    result = run(clone, os.environ["PATH"], PYTHON=BASE, ROS_DISTRO="jazzy")
    assert_refused(result, clone, "AMENT_PREFIX_PATH", "source /opt/ros/jazzy/setup.bash")


def test_failed_installation_does_not_count_as_set_up(clone):
    # Nothing listens on port 9 of this machine, as if there were no network.
    network = {"PIP_INDEX_URL": "http://127.0.0.1:9/simple", "PIP_RETRIES": "1"}
    network |= {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_CACHE_DIR": "1"}
    result = run(clone, os.environ["PATH"], PYTHON=BASE, **network)
    assert_refused(result, clone, "package index cannot be reached", "setup.log")
    shell = run(clone, os.environ["PATH"], command=("bash", "-uc", ". ./setup.bash"))
    assert_refused(shell, clone, "not set up yet", "make -C")


@pytest.mark.parametrize("name", ["wheels.txt", "jazzy.txt"])
def test_every_pin_is_exact_and_has_the_hashes_of_its_files(name):
    lines = [x for x in (ROOT / "requirements" / name).read_text().splitlines() if x[:1] != "#"]
    pins = [k for k, line in enumerate(lines) if not line.startswith(" ")]
    assert len(pins) > 50
    for begin, end in zip(pins, [*pins[1:], len(lines)]):
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[^ ;]+( ; [^\\]+)? \\", lines[begin]), lines[begin]
        assert end - begin > 1, f"{lines[begin]}: no hash"
        for line in lines[begin + 1 : end]:
            assert re.fullmatch(r" {4}--hash=sha256:[0-9a-f]{64}( \\)?", line), line


def keys(clone):
    script = "import json, environment; print(json.dumps(environment.stage_keys('')))"
    result = run(clone / "scripts", os.environ["PATH"], command=(BASE, "-c", script))
    return json.loads(result.stdout)


@pytest.mark.parametrize(
    ("path", "stages"),
    [
        ("requirements/wheels.txt", {"packages"}),
        ("smp_interfaces/msg/MotorState.msg", {"package"}),
        ("setup.py", {"package"}),
        ("config/new.yaml", {"package"}),
        ("smp_motor_control/motor.py", set()),
    ],
)
def test_change_repeats_only_dependent_stages(clone, path, stages):
    before = keys(clone)
    changed = clone / path
    changed.parent.mkdir(exist_ok=True)
    with changed.open("a", encoding="utf-8") as file:
        file.write("# changed\n")
    after = keys(clone)
    assert {name for name in before if before[name] != after[name]} == stages


def test_second_set_up_waits_for_the_first(clone, process, eventually):
    with (clone / ".setup.lock").open("w", encoding="ascii") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        no_ros = {"PYTHON": BASE, "ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": ""}
        second = process("scripts/setup.sh", cwd=clone, env=no_ros)
        eventually(lambda: "waiting" in second.output)
        assert second.returncode is None
    # With the lock it reports that ROS is missing.
    assert second.wait(30.0) == 1


@pytest.fixture
def ready():
    if not (ROOT / ".venv" / "ready").is_file():
        pytest.skip("this tree was built by colcon alone")


def test_repeated_set_up_is_silent_and_fast(ready):
    for _ in range(2):  # the first may still have something to do
        started = time.monotonic()
        result = run(ROOT, os.environ["PATH"], **ROS)
        elapsed = time.monotonic() - started
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    assert elapsed < 3.0  # longest start of a second `make test`


def test_shell_in_another_folder_finds_executables_and_messages(ready, tmp_path):
    script = (
        f"set -eu; . '{ROOT}/setup.bash'; command -v wheel_pid identify demo;"
        " python -c 'import rclpy; from smp_interfaces.msg import MotorState; print(MotorState())'"
    )
    result = run(tmp_path, "/usr/bin:/bin", command=("bash", "-c", script))
    assert result.returncode == 0, result.stderr
    assert "encoder_count=0" in result.stdout


def test_shell_does_not_set_discovery_range(ready, tmp_path):
    script = f". '{ROOT}/setup.bash'; env | grep -c '^ROS_AUTOMATIC_DISCOVERY_RANGE'"
    assert run(tmp_path, "/usr/bin:/bin", command=("bash", "-c", script)).stdout == "0\n"


def test_pytest_works_with_a_sourced_launch_testing_plugin(tmp_path):
    # Its hook takes an argument that pytest 9 no longer gives.
    (tmp_path / "older.py").write_text("def pytest_pycollect_makemodule(path, parent): ...\n")
    package = tmp_path / "launch_testing-3.4.3.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Name: launch_testing\nVersion: 3.4.3\n")
    (package / "entry_points.txt").write_text("[pytest11]\nlaunch_testing = older\n")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "pytest", "-q", "--co", "test/system/test_robots.py"]
    ran = subprocess.run(command, cwd=ROOT, env=os.environ | {"PYTHONPATH": path},
                         capture_output=True, text=True, timeout=120, check=False)  # fmt: skip
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_root_package_declares_dependencies_of_smp_interfaces():
    """rosdep does not search below a folder with a package.xml."""

    def keys(path: str) -> set[str]:
        root = ElementTree.parse(ROOT / path).getroot()
        return {one.text for one in root if one.tag.endswith("depend")}

    named = keys("package.xml")
    assert keys("smp_interfaces/package.xml") <= named
    known = (ROOT / "scripts" / "rosdep_keys.txt").read_text().splitlines()
    assert named <= set(known)


HEADER = "# SPDX-License-Identifier: Apache-2.0\n"


@pytest.fixture
def check(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Return a function that tracks files and runs one guard on them."""
    (tmp_path / "scripts").mkdir()
    for name in ("check.sh", "licence.sh"):
        shutil.copy(ROOT / "scripts" / name, tmp_path / "scripts")
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)

    def run(guard: str, files: dict[str, str]) -> subprocess.CompletedProcess[str]:
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
        subprocess.run(["git", "add", "--all", "--force"], cwd=tmp_path, check=True)
        command = ["scripts/check.sh", guard]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    return run


def test_python_files_without_a_licence_are_reported(check):
    sound = {"a.py": HEADER + "x = 1\n", "b.py": f"#!/usr/bin/env python3\n{HEADER}", "c.py": ""}
    assert check("licence", sound).returncode == 0
    done = check("licence", {"folder/d.py": "x = 1\n", "e.py": HEADER.replace("Apache", "MIT")})
    assert done.returncode == 1
    assert {"folder/d.py", "e.py"} <= set(done.stdout.split())
    assert "a.py" not in done.stdout.split()


def test_licence_header_is_inserted_once_after_the_shebang(check, tmp_path):
    check("licence", {"a.py": "x = 1\n", "b.py": "#!/usr/bin/env python3\ny = 1\n", "c.py": ""})
    for _ in range(2):
        subprocess.run([tmp_path / "scripts/licence.sh", "insert"], cwd=tmp_path, check=True)
    read = {path.name: path.read_text() for path in tmp_path.glob("*.py")}
    assert read == {
        "a.py": HEADER + "x = 1\n",
        "b.py": f"#!/usr/bin/env python3\n{HEADER}y = 1\n",
        "c.py": "",
    }
    assert check("licence", {}).returncode == 0


@pytest.mark.parametrize(
    "name",
    [
        ".cache/matplotlib/fontlist.json",
        ".rustup/settings.toml",
        "smp/__pycache__/a.cpython-311.pyc",
        "a.nbi",
        ".mypy_cache/x.json",
        "smp.egg-info/PKG-INFO",
        "patch.orig",
        "docs/.DS_Store",
    ],
)
def test_leftover_files_of_tools_are_reported(check, name):
    assert check("leftovers", {"cache.py": "", ".gitignore": "", ".ci/run": ""}).returncode == 0
    done = check("leftovers", {name: "x"})
    assert done.returncode == 1
    assert name in done.stdout.split()


PACKAGES = ("smp_motor_control/", "smp_motor_ident/")


@pytest.fixture(scope="module")
def tracked() -> list[str]:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("this tree is no clone")
    return [name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def built(tracked, tmp_path_factory) -> Path:
    """Return the folder of a source distribution and a wheel of the tracked files."""
    folder = tmp_path_factory.mktemp("tree")
    for name in tracked:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes((ROOT / name).read_bytes())
    for link in ("gone.md", "docs/gone.md", "docs/gone/gone.md"):  # as colcon leaves of moved files
        (folder / link).parent.mkdir(exist_ok=True)
        (folder / link).symlink_to("/nowhere")
    command = [sys.executable, "setup.py", "-q", "sdist", "bdist_wheel"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / "dist"


def test_wheel_holds_every_tracked_file_of_the_packages(built, tracked):
    with zipfile.ZipFile(next(built.glob("*.whl"))) as wheel:
        held = set(wheel.namelist())
    assert {name for name in tracked if name.startswith(PACKAGES)} <= held
    assert not [name for name in held if name.startswith(("test/", "smp_interfaces/"))]


def test_source_distribution_holds_every_tracked_file(built, tracked):
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    assert not set(tracked) - held


@pytest.mark.parametrize("lock", ["wheels.txt", "jazzy.txt"])
def test_every_requirement_is_pinned_within_its_range(lock, monkeypatch):
    given = {}
    monkeypatch.setattr("setuptools.setup", lambda **keywords: given.update(keywords))
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(ROOT / "setup.py"))
    pins: dict[str, list[str]] = {}
    for name in (lock, "jazzy-apt.in"):
        for line in (ROOT / "requirements" / name).read_text().splitlines():
            if line and line[0] not in " #":
                pin = Requirement(line.removesuffix("\\"))
                pins.setdefault(canonicalize_name(pin.name), []).append(
                    str(pin.specifier).removeprefix("==")
                )
    extras = ("lab", "xlsx", "matlab", *(() if lock == "jazzy.txt" else ("ros",)))
    for text in [
        *given["install_requires"],
        *(t for e in extras for t in given["extras_require"][e]),
    ]:
        wanted = Requirement(text)
        assert any(
            version in wanted.specifier for version in pins.get(canonicalize_name(wanted.name), ())
        ), text


def test_container_image_runs_the_commands_of_the_readme():
    block = (ROOT / "README.md").read_text().split("## With ROS 2")[1].split("```")[1]
    said = [line.partition("#")[0].strip() for line in block.splitlines()]
    recipe = (ROOT / "Dockerfile").read_text()
    for command in said:
        if command.startswith(("rosdep", "pip", "colcon")):
            assert command in recipe, command
    stages = re.findall(r"^FROM (\S+)(?: AS (\w+))?", recipe, re.MULTILINE)
    assert stages[0][0] == "ros:jazzy"
    container = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text())
    assert container["build"]["target"] in dict(stages).values()
    assert (ROOT / ".devcontainer" / container["build"]["dockerfile"]).is_file()


def test_all_packages_have_the_same_version():
    changelogs = ("CHANGELOG.rst", "smp_interfaces/CHANGELOG.rst")
    found = {
        n: re.findall(r"^(\S+) \(\d{4}-\d\d-\d\d\)\n-+$", (ROOT / n).read_text(), re.M)[0]
        for n in changelogs
    }
    found |= {
        n: re.findall(r"<version>(.+)</version>", (ROOT / n).read_text())[0]
        for n in ("package.xml", "smp_interfaces/package.xml")
    }
    found["setup.py"] = re.findall(r'version="(.+)"', (ROOT / "setup.py").read_text())[0]
    assert len(set(found.values())) == 1, found
