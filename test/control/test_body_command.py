# SPDX-License-Identifier: Apache-2.0
"""Time-out of a velocity command (behaviour_cases of diff_drive_cases.json)."""

import math

import pytest

from smp_motor_control.body.command import BodyCommand, Verdict


def test_nothing_is_asked_before_the_first_command_even_if_that_is_nan():
    command = BodyCommand()
    assert command.at(0.0) is None
    assert command.receive(math.nan, 0.0, 0.0, 0.0) is Verdict.NOT_FINITE
    assert command.at(0.0) is None


def test_command_brakes_after_the_timeout_and_not_before():
    command = BodyCommand(0.5)
    assert command.receive(1.0, 0.0, 0.0, 10.0) is Verdict.ACCEPTED
    assert command.at(10.5) == (1.0, 0.0)
    assert command.at(10.501) == (0.0, 0.0)
    command.receive(1.0, 0.0, 0.0, 11.0)
    assert command.at(11.0) == (1.0, 0.0)


def test_timeout_of_zero_lets_a_command_hold():
    command = BodyCommand(0.0)
    command.receive(1.0, 0.0, 100.0, 1.0)
    assert command.at(11.0) == (1.0, 0.0)


def test_zero_stamp_is_taken_as_now():
    command = BodyCommand(0.5)
    assert command.receive(1.0, 0.0, None, 10.0) is Verdict.ZERO_STAMP
    assert command.at(10.4) == (1.0, 0.0)


@pytest.mark.parametrize(("age", "accepted"), [(0.499, True), (0.5, False), (3.0, False)])
def test_stale_command_is_dropped_on_arrival(age, accepted):
    command = BodyCommand(0.5)
    verdict = command.receive(1.0, 0.0, age, 10.0)
    assert (verdict is Verdict.ACCEPTED) == accepted
    assert (command.at(10.0) is not None) == accepted


def test_age_on_arrival_counts_for_the_timeout():
    command = BodyCommand(0.5)
    command.receive(1.0, 0.0, 0.4, 10.0)
    assert command.at(10.11) == (0.0, 0.0)


def test_stamp_from_the_future_does_not_hold_any_longer():
    command = BodyCommand(0.5)
    command.receive(1.0, 0.0, -3600.0, 10.0)
    assert command.at(10.51) == (0.0, 0.0)


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
