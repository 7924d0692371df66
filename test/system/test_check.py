# SPDX-License-Identifier: Apache-2.0
"""The guards of `make check` that inspect tracked files."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
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
