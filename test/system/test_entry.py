"""Ctrl-C in the first second: while an executable is still importing."""

from __future__ import annotations

from pathlib import Path

import pytest


def has_mapped(pid: int, library: str) -> bool:
    try:
        return library in Path(f"/proc/{pid}/maps").read_text()
    except FileNotFoundError:
        return False


@pytest.mark.parametrize(
    ("executable", "library", "code"),
    [
        # numpy is among the first that is imported, and far from the last
        ("wheel_pid", "_multiarray_umath", 0),
        ("skid_steer", "_multiarray_umath", 0),
        ("identify", "_multiarray_umath", 130),
        ("tune", "_multiarray_umath", 130),
    ],
)
def test_ctrl_c_while_importing_ends_an_executable_without_a_traceback(
    process, eventually, executable, library, code
):
    started = process(executable, "--ros-args", "-r", "__ns:=/front_left")
    eventually(lambda: has_mapped(started.pid, library), 20.0)
    started.interrupt()
    # A tool may have come as far as its arguments, which it then refuses.
    assert started.wait(5.0) in (code, 2 if code else 0)
    assert "Traceback" not in started.output
