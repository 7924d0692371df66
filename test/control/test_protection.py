# SPDX-License-Identifier: Apache-2.0
"""Limits that end a test of a motor."""

import math

import pytest

from smp_motor_control.wheel.protection import Bounds, Protection


@pytest.mark.parametrize(("what", "words"), [("speed", "turns at 20"), ("current", "is 20 A")])
def test_one_bad_sample_stops_nothing_and_a_twentieth_of_a_second_does(what, words):
    def sample(k: int, value: float) -> tuple[float, float, float]:
        current, speed = (0.1, value) if what == "speed" else (value, 1.0)
        return 1e9 + 0.01 * k, current, speed

    watched = Protection(Bounds(speed=10.0, current=10.0))
    once = [watched.add(*sample(k, 20.0 if k % 4 == 0 else 1.0)) for k in range(100)]
    assert not any(once)
    # Of either sign; six samples of 10 ms span 50 ms.
    said = [watched.add(*sample(100 + k, -20.0)) for k in range(7)]
    assert not any(said[:5]) and words in said[-1]


def test_without_limits_or_a_sensor_of_current_nothing_is_judged():
    for bounds in (Bounds(), Bounds(current=1.0)):
        watched = Protection(bounds)
        assert not any(watched.add(1e9 + 0.01 * k, math.nan, 1e3) for k in range(4000))
