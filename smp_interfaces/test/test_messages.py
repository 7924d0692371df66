# SPDX-License-Identifier: Apache-2.0
"""Every field of every message has a comment and unit, and every message is built."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1]
MESSAGES = sorted((PACKAGE / "msg").glob("*.msg"))


@pytest.mark.parametrize("path", MESSAGES, ids=lambda path: path.stem)
def test_every_field_has_a_comment_and_every_float_a_unit(path):
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# ")
    for line in text.splitlines():
        if not line or line.startswith("#"):
            continue
        declared, _, comment = line.partition("#")
        assert comment.strip(), f"{path.name}: {line}"
        if declared.startswith("float64 "):
            assert re.match(r"\s*\[.+\]", comment), f"{path.name}: {line}: no unit"


def test_every_message_is_listed_in_cmake():
    built = re.findall(r"msg/(\w+)\.msg", (PACKAGE / "CMakeLists.txt").read_text())
    assert built == [path.stem for path in MESSAGES]
