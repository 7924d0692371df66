# SPDX-License-Identifier: Apache-2.0
"""Compiled functions survive a cache that another version left, or that was cut off."""

import os
import pickle
import subprocess
import sys

import numba
import pytest

PROGRAM = """
import numpy as np
from smp_motor_ident.fit.noise import fit_noise
print(fit_noise(np.arange(9.0), np.array([[0, 9]])).order)
"""


def _run(folder):
    made = subprocess.run(
        [sys.executable, "-c", PROGRAM], env={**os.environ, "NUMBA_CACHE_DIR": str(folder)},
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    return made.stdout.strip() or made.stderr


@pytest.mark.parametrize("left", [b"csmp_motor_ident.gone\nMotor\n.", b"\x80\x04"])
def test_unreadable_cache_is_compiled_again(tmp_path, left):
    assert _run(tmp_path) == "0"
    index = next(tmp_path.rglob("*_estimate_reflections*.nbi"))
    index.write_bytes(pickle.dumps(numba.__version__) + left)
    assert _run(tmp_path) == "0"
    with index.open("rb") as file:
        assert pickle.load(file) == numba.__version__
        _, signatures = pickle.load(file)
    assert len(signatures) == 1
