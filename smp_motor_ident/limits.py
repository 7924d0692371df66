# SPDX-License-Identifier: Apache-2.0
"""Every threshold of a decision, as a number by its name, read from the table in ``limits.md``.

The table states their units, reasons, and the tests that show them.
"""

import ast
import re
from pathlib import Path
from typing import TYPE_CHECKING

_ROW = re.compile(r"\| `(\w+)` \| (\S+) \|")

for _line in Path(__file__).with_suffix(".md").read_text("utf-8").splitlines():
    if _row := _ROW.match(_line):
        globals()[_row[1]] = ast.literal_eval(_row[2])

if TYPE_CHECKING:

    def __getattr__(name: str) -> float: ...
