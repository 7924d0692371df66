# SPDX-License-Identifier: Apache-2.0
"""Damaged and hostile files are read or refused in one line, within bounded memory."""

import random
import resource
import subprocess
import sys
from pathlib import Path

import lz4.frame
import pytest
from backports import zstd
from bench_scripts import load
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from recordings import assert_refused

from smp_motor_ident.bag import read_records
from smp_motor_ident.errors import BagError

ROOT = Path(__file__).resolve().parents[3]
FUZZ = load("fuzz")


@pytest.mark.parametrize("name", list(FUZZ.SEEDS))
def test_intact_file_of_every_format_is_read(tmp_path, name):
    FUZZ.SOUND.update({key: FUZZ.SEEDS[key][1]() for key in {name, "mcap", "sqlite"}})
    assert FUZZ.outcome(name, FUZZ.SOUND[name], tmp_path) == "answer"


@pytest.mark.parametrize("name", list(FUZZ.SEEDS))
@settings(
    max_examples=6,
    derandomize=True,  # benchmarks/fuzz.py uses other seeds
    deadline=30_000,  # ms, as benchmarks/fuzz.py: a MATLAB file starts two processes of scipy
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(seed=st.integers(0, 2**32))
def test_corrupted_file_is_read_or_refused_in_one_line(tmp_path, name, seed):
    if name not in FUZZ.SOUND:
        FUZZ.SOUND.update({key: FUZZ.SEEDS[key][1]() for key in {name, "mcap", "sqlite"}})
    spoilt = FUZZ.spoil(FUZZ.SOUND[name], random.Random(seed))
    assert FUZZ.outcome(name, spoilt, tmp_path) in ("answer", "partial", "refused")


def test_control_characters_in_error_message_are_replaced():
    assert str(BagError("has /joint_sta\nes\x1b[2J")) == "has /joint_sta\ufffdes\ufffd[2J"


def test_long_error_message_is_shortened_in_the_middle():
    long = BagError(f"a.yaml: left: {'- ' * 3000}is not SOURCE")
    assert len(str(long)) < 1100
    assert str(long).startswith("a.yaml: left: -") and str(long).endswith("- is not SOURCE")
    assert str(BagError("a.yaml: " + 900 * "x")) == "a.yaml: " + 900 * "x"


def test_matlab_file_that_crashes_its_reader_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.mat"
    path.write_bytes(FUZZ.SEEDS["mat"][1]())
    reader = tmp_path / "reader.py"
    reader.write_text("import os; os.abort()")
    monkeypatch.setattr("smp_motor_ident.bag.readers.apart.PROGRAM", reader)
    assert_refused(r"a\.mat: damaged MATLAB file", path, FUZZ.COLUMNS)


def bomb(kind: str, size: int) -> bytes:
    """Return a compressed MCAP file of zeros after its magic bytes."""
    head = b"\x89MCAP0\r\n"
    if kind == "lz4":
        return lz4.frame.compress(head + bytes(size), store_size=True)
    return zstd.compress(head + bytes(size), 19)


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_decompression_bomb_is_refused_within_bounded_memory(tmp_path, kind):
    path = tmp_path / f"bag.mcap.{kind}"
    path.write_bytes(bomb(kind, 400_000_000))
    # VmHWM starts at zero in each process; ru_maxrss includes the parent's peak.
    code = (
        "import re, sys\n"
        "from pathlib import Path\n"
        "from smp_motor_ident.bag import read_records\n"
        "from smp_motor_ident.errors import BagError\n"
        "status = Path('/proc/self/status')\n"
        "peak = lambda: int(re.findall(r'VmHWM:\\s+(\\d+)', status.read_text())[0])\n"
        "before = peak()\n"
        "try:\n    read_records(sys.argv[1])\n"
        "except BagError as error:\n    print(error)\n"
        "print(peak() - before)\n"
    )
    command = [sys.executable, "-c", code, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    message, kilobytes = done.stdout.splitlines()
    assert "SMP_BAG_UNPACKED" in message and path.name in message
    assert int(kilobytes) < 100_000  # unpacked on disk, a piece at a time


def test_lz4_frame_with_false_size_allocates_no_memory(tmp_path):
    frame = bytearray(lz4.frame.compress(b"\x89MCAP0\r\n" + bytes(1000), store_size=True))
    frame[6:14] = (4_400_000_000).to_bytes(8, "little")  # the header's checksum fails as well
    path = tmp_path / "bag.mcap.lz4"
    path.write_bytes(bytes(frame))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BagError):
        read_records(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB
