# SPDX-License-Identifier: Apache-2.0
"""Read formats in a separate process, since their libraries may hang, crash or fill the memory."""

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError

PROGRAM = Path(__file__).parent / "program.py"
TIMEOUT_S, TIMEOUT_PER_BYTE_S = 15.0, 1e-6
"""Longest time to read a file [s], and addition per byte of it."""


def read(kind: str, path: Path, name: str, budget: Budget) -> tuple[dict[str, Any], io.BytesIO]:
    """Return the program's description of a file, and its data."""
    command = [sys.executable, str(PROGRAM), kind, str(path), str(budget.left)]
    patience = TIMEOUT_S + TIMEOUT_PER_BYTE_S * path.stat().st_size
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=patience)
    except subprocess.TimeoutExpired:
        raise BagError(
            f"{name}: is not read after {patience:.0f} s, too long for its size; save "
            "its columns as CSV"
        ) from None
    if done.returncode:
        raise BagError(f"{name}: damaged {kind} file (its reader ends with {done.returncode})")
    answer = io.BytesIO(done.stdout)
    head = json.loads(answer.readline())
    if head["too_large"]:
        budget.take(budget.left + 1)
    budget.take(len(done.stdout))
    if head["error"]:
        raise BagError(f"{name}: {head['error']}")
    return head, answer
