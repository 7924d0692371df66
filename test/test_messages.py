# SPDX-License-Identifier: Apache-2.0
"""All messages of tools and nodes, as listed in docs/messages.md, follow the style rules."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "messages.md").read_text()
MESSAGES = re.findall("^- (.*)", PAGE, re.MULTILINE)

FAULTS = {
    "longer than 260 characters": r".{261}",
    "more than two sentences": r"[.?] [A-Z].*[.?] [A-Z]",
    # In words: "resistance", "DC gain"; names to type, such as parameters, keep their underscores.
    "a quantity in code": r"(?<!\.)\b(dc_gain|time_constant|static_voltage|\w+_friction)\b",
    "a number without unit": r"\b(at|about|for|in|every|within|reaches) N(?! [A-Za-z%…])",
    "a percent sign without a space": r"[N\d]%",
    "an obscure phrase": r"\b(what (is|the|it)|of which|beside|is none|are no|(?<!there )is no)\b",
}  # fmt: skip


def test_messages_page_matches_the_code():
    script = [sys.executable, ROOT / "scripts" / "messages.py"]
    made = subprocess.run(script, capture_output=True, text=True, check=True).stdout
    assert made == PAGE, "python scripts/messages.py > docs/messages.md"


@pytest.mark.parametrize("fault", FAULTS)
def test_no_message_has_style_fault(fault):
    assert len(MESSAGES) > 400
    assert [one for one in MESSAGES if re.search(FAULTS[fault], one)] == []
