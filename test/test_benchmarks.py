# SPDX-License-Identifier: Apache-2.0
"""Benchmarks, which no other test runs, import only existing public names."""

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
SCRIPTS = sorted(FOLDER.glob("*.py"))


def list_imports(path: Path) -> Iterator[tuple[str, str]]:
    """Yield module and name of every import of a script, those within functions too."""
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            yield from ((each.name, "") for each in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, each.name) for each in node.names)


def list_definitions(path: Path) -> set[str]:
    """Return the names that a script binds at its top level."""
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            names |= {(each.asname or each.name).split(".")[0] for each in node.names}
        else:
            names |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
    return names


def exists(module: str, name: str) -> bool:
    """Tell whether a module of the project, or a script of the folder, has a name."""
    script = FOLDER / f"{module}.py"
    if script.exists():
        return not name or name in list_definitions(script)
    found = importlib.import_module(module)
    if not name or hasattr(found, name):
        return True
    try:
        importlib.import_module(f"{module}.{name}")
    except ImportError:
        return False
    return True


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_benchmarks_import_only_existing_public_names(path):
    ours = {script.stem for script in SCRIPTS}
    for module, name in list_imports(path):
        if module in ours or module.startswith("smp_"):
            assert not name.startswith("_"), f"{module}.{name} is private"
            assert exists(module, name), f"{module} has no {name}"
