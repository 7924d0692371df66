# SPDX-License-Identifier: Apache-2.0
"""Time-out of a velocity command (behaviour_cases of diff_drive_cases.json)."""

import math

import pytest

from smp_motor_control.body.command import BodyCommand, Verdict


def test_there_is_no_command_before_the_first_finite_one():
    command = BodyCommand()
    assert command.at(0.0) is None
    assert command.receive(math.nan, 0.0, 0.0, 0.0) is Verdict.NOT_FINITE
    assert command.at(0.0) is None


DRIVES, STOPS = (1.0, 0.0), (0.0, 0.0)


@pytest.mark.parametrize(
    ("timeout", "age", "verdict", "asked"),
    [
        (0.5, 0.0, Verdict.ACCEPTED, {10.5: DRIVES, 10.501: STOPS}),
        (0.0, 100.0, Verdict.ACCEPTED, {20.0: DRIVES}),  # no time-out
        (0.5, None, Verdict.ZERO_STAMP, {10.4: DRIVES}),
        (0.5, 0.499, Verdict.ACCEPTED, {10.0: DRIVES}),
        (0.5, 0.5, Verdict.STALE, {10.0: None}),
        (0.5, 3.0, Verdict.STALE, {10.0: None}),
        (0.5, 0.4, Verdict.ACCEPTED, {10.11: STOPS}),
        (0.5, -3600.0, Verdict.ACCEPTED, {10.51: STOPS}),  # a stamp from the future
    ],
)
def test_command_age_counts_towards_time_out(timeout, age, verdict, asked):
    command = BodyCommand(timeout)
    assert command.receive(*DRIVES, age, 10.0) is verdict
    assert {at: command.at(at) for at in asked} == asked
    command.receive(*DRIVES, 0.0, 11.0)
    assert command.at(11.0) == DRIVES


@pytest.mark.parametrize("bad", [(math.nan, 0.0), (0.0, math.inf), (-math.inf, math.nan)])
def test_non_finite_command_does_not_reset_the_time_out(bad):
    command = BodyCommand(0.5)
    command.receive(1.0, 0.5, 0.0, 10.0)
    for k in range(1, 11):
        assert command.receive(*bad, 0.0, 10.0 + 0.1 * k) is Verdict.NOT_FINITE
        expected = (1.0, 0.5) if k <= 5 else (0.0, 0.0)
        assert command.at(10.0 + 0.1 * k - 0.01) == expected


def test_reset_forgets_the_command():
    command = BodyCommand(0.5)
    command.receive(1.0, 0.5, 0.0, 10.0)
    command.reset()
    assert command.at(10.0) is None
