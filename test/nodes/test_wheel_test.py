# SPDX-License-Identifier: Apache-2.0
"""Evaluation of the samples of a wheel test."""

import math

import pytest

from smp_motor_control.nodes.wheel_test import Row, WheelRecording


def recording(position) -> WheelRecording:
    """Return 8 s of a wheel at 2 rad/s whose driver reports ``position(angle)``."""
    rows = [Row(1e4 + t, 0.0, 3.0, 3.0, 2.0, position(2.0 * t), 0.0, 1.0)
            for t in (0.01 * k for k in range(800))]  # fmt: skip
    return WheelRecording(rows)


@pytest.mark.parametrize(
    ("position", "words"),
    [
        (lambda angle: angle, ""),
        (lambda angle: math.nan, ""),
        (lambda angle: 0.0, "never changes"),
        (lambda angle: angle % (2 * math.pi), "wraps"),
        (lambda angle: math.remainder(angle, 2 * math.pi), "wraps"),
        (lambda angle: angle if angle < 9.0 else angle - 9.0, "jumped"),
    ],
)
def test_position_unusable_for_odometry_is_reported(position, words):
    said = recording(position).position_problem()
    assert words in said and bool(words) is bool(said)


def test_empty_recording_has_no_position_problem():
    assert WheelRecording().position_problem() == ""
