# SPDX-License-Identifier: Apache-2.0
"""The documented table of faults names existing tests and every row of the fault matrix."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "docs" / "decisions" / "when-a-wheel-stops.md"
_SOURCE = (ROOT / "test" / "control" / "test_wheel_controller.py").read_text()
MATRIX = re.findall(
    r'^    \("([^"]+)"', _SOURCE.split("MATRIX = [")[1].split("\n]")[0], re.MULTILINE
)


def rows() -> list[list[str]]:
    lines = [line for line in TABLE.read_text().splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[2:]]


def test_every_documented_fault_names_an_existing_test():
    sources = "\n".join(path.read_text() for path in (ROOT / "test").rglob("test_*.py"))
    known = set(re.findall(r"^def (test_\w+)\(", sources, re.MULTILINE))
    known |= {f"MATRIX: {name}" for name in MATRIX}
    named: set[str] = set()
    assert len(rows()) > 20 and len(MATRIX) > 12
    for row in rows():
        assert len(row) == 6 and all(row), row
        tests = re.findall(r"`([^`]+)`", row[5])
        assert tests, f"{row[0]}: no test"
        for test in tests:
            assert test in known or (ROOT / test).is_file(), f"{row[0]}: there is no {test}"
        named |= set(tests)
    assert {f"MATRIX: {name}" for name in MATRIX} <= named
