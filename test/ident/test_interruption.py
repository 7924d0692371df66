# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C reaches a tool even when Python drops the exception."""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import weakref
from functools import partial

import pytest

from smp_motor_ident.cli import frame, interruption


class Thing:
    """An object that supports weak references."""


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_in_a_non_raising_callback_is_raised_at_the_next_check(number):
    def in_callback(_: object) -> None:
        os.kill(os.getpid(), number)
        for _ in range(1000):
            pass  # the handler runs between two of these

    with interruption.interruptible():
        thing = Thing()
        reference = weakref.ref(thing, in_callback)
        del thing  # the exception that the callback raises is dropped here
        assert reference() is None
        with pytest.raises(KeyboardInterrupt):
            interruption.check()


def test_an_interruption_is_cleared_after_the_block():
    with pytest.raises(KeyboardInterrupt), interruption.interruptible():
        os.kill(os.getpid(), signal.SIGINT)
    with interruption.interruptible():
        interruption.check()


def test_interruption_of_an_inner_block_reaches_the_outer_block():
    with interruption.interruptible():
        with pytest.raises(KeyboardInterrupt), interruption.interruptible():
            os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            interruption.check()


def test_earlier_handlers_are_restored():
    before = signal.getsignal(signal.SIGTERM)
    with interruption.interruptible():
        assert signal.getsignal(signal.SIGTERM) is not before
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_protected_block_is_completed_before_an_interruption():
    done: list[str] = []

    def work() -> None:
        with interruption.delayed():
            os.kill(os.getpid(), signal.SIGTERM)
            done.append("all of it")

    with interruption.interruptible(), pytest.raises(KeyboardInterrupt):
        work()
    assert done


def test_error_after_a_suppressed_interruption_is_reported_as_interruption(capsys):
    def compiles(arguments: argparse.Namespace) -> int:
        with contextlib.suppress(KeyboardInterrupt):  # as a callback of a compiler does
            signal.raise_signal(signal.SIGTERM)
        raise RuntimeError("no compiled object yet")

    assert frame.run(partial(argparse.ArgumentParser, "tool"), compiles, []) == 130
    assert capsys.readouterr().err == "tool: interrupted\n"


def test_ctrl_z_interrupts_only_a_tool_that_is_connected_to_a_robot():
    with interruption.interruptible():
        assert signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL
        with pytest.raises(KeyboardInterrupt), interruption.interruptible(signal.SIGTSTP):
            os.kill(os.getpid(), signal.SIGTSTP)
        assert signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL
        with pytest.raises(KeyboardInterrupt):
            interruption.check()


def test_ctrl_z_leaves_no_helper_process_suspended():
    program = """
import os, signal, subprocess, time
from smp_motor_ident.cli import interruption

helper = subprocess.Popen(["sleep", "0.5"])
try:
    with interruption.interruptible(signal.SIGTSTP):
        os.killpg(0, signal.SIGTSTP)
        time.sleep(60.0)
except KeyboardInterrupt:
    helper.wait()
    print("both ended")
"""
    command = [sys.executable, "-c", program]
    done = subprocess.run(
        command, preexec_fn=os.setpgrp, timeout=60.0, capture_output=True, check=True
    )
    assert done.stdout == b"both ended\n"
