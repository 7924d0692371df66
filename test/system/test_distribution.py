# SPDX-License-Identifier: Apache-2.0
"""pip and colcon install all files of the repository's packages."""

import json
import re
import runpy
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
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
