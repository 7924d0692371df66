# SPDX-License-Identifier: Apache-2.0
"""A driver that puts out nothing of small commands, as its firmware's least PWM makes it."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate

LEAST = 1.5  # [V]


@pytest.mark.parametrize("current", [False, True])
def test_a_driver_that_ignores_small_commands_is_named_and_leaves_the_motor_right(current):
    level = 0.6 * np.random.default_rng(3).integers(-15, 16, 30)
    command = np.repeat(level, 100)
    made = motors.record(current=current, voltage=np.where(np.abs(command) < LEAST, 0.0, command))
    found = estimate(replace(made, voltage=command))
    assert "hard_dead_zone" in [f.code for f in found.findings]
    # No command lies in between, so the data tell no more.
    least = found.combinations["least_command"]
    assert 1.2 < least.value < 1.8
    assert 0.05 < least.total_std < 0.6
    assert least.total_ci95[0] < LEAST < least.total_ci95[1]
    truth = motors.truth("rear_left", 0.3)
    for name in ("dc_gain", "time_constant", "static_voltage"):
        assert found.value(name) == pytest.approx(truth[name], rel=2e-3)
