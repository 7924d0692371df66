# SPDX-License-Identifier: Apache-2.0
"""Speed readings that a motor cannot have reached since the previous sample are rejected."""

from types import SimpleNamespace

import numpy as np
import pytest

from smp_motor_control.encoder import Encoder
from smp_motor_control.motor.parameters import Gearbox
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Drive
from smp_motor_control.wheel.controller import WheelController, WheelSettings
from smp_motor_control.wheel.faults import FaultLimits
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop

STEP = 0.01
GAINS = PidGains(p=2.0, feedforward_acceleration=2.0, u_clamp_min=-12.0, u_clamp_max=12.0)
DRIVE = Drive(top_speed=10.0, time_constant=0.2)  # 0.1 rad/s per sample at 12 V, from rest


def drive_with_readings(speeds, drive=DRIVE) -> tuple[WheelController, list[bool]]:
    """Feed a wheel with speed readings; return it and whether each reading was rejected."""
    quiet = FaultLimits(stall_time=0.0, runaway_time=0.0, tracking_time=0.0)
    wheel = WheelController(
        WheelSettings(loop=LoopSettings(gains=GAINS, drive=drive), faults=quiet)
    )
    wheel.set_hardware(Gearbox(1.0), Encoder(64.0), 12.0)
    wheel.activate(0.0)
    out = []
    quiet_before = [0.0] * 200
    for k, speed in enumerate([*quiet_before, *speeds], 1):
        now = k * STEP
        wheel.take_setpoint(0.0, now)
        sample = SimpleNamespace(voltage=0.0, current=np.nan, velocity=speed, encoder_count=0)
        answer = wheel.take_feedback(sample, round(1e9 * now), round(1e9 * now), now)
        wheel.tick(now)
        out.append(answer is None)
    return wheel, out[len(quiet_before) :]


def test_single_speed_jump_is_rejected_and_repeated_one_accepted():
    """A motor cannot change its speed by half of its top speed in a sample; a collision can."""
    for readings, out in (([4.9, 0.0], [False, False]), ([5.2, 0.2], [True, False]),
                          ([-9.0, -8.9, -8.9], [True, False, False])):  # fmt: skip
        wheel, left_out = drive_with_readings(readings)
        assert left_out == out
        assert wheel.refused["feedback speed that jumps"] == sum(out)


def test_outliers_in_one_percent_of_readings_are_all_rejected():
    readings = np.where(np.arange(3000) % 100 == 0, 8.0, 0.0)
    assert np.array_equal(drive_with_readings(readings)[1], readings > 0.0)


def test_moderate_speed_jumps_are_accepted_with_unknown_drive():
    assert not any(drive_with_readings([0.0, 5.2, 0.2, -9.0, 9.0], drive=None)[1])


@pytest.mark.parametrize("steps", [6.0, 11.0])
def test_coarsely_quantised_readings_are_accepted(steps):
    """Readings of zero or one count, as when counts are differenced over one sample."""
    rng = np.random.default_rng(1)
    wheel, left_out = drive_with_readings(steps * (rng.random(2000) < 0.3))
    assert np.mean(left_out) < 0.01
    assert not any(left_out[100:])


@pytest.mark.parametrize(("source", "window"), [("measured", 1), ("difference", 2)])
@pytest.mark.parametrize(("counts", "jumps"), [(1, 0), (3, 1)])
def test_single_counts_of_coarse_encoder_are_not_rejected(source, window, counts, jumps):
    """One of eight counts is 79 rad/s over one sample and 39 over two; top speed is 10."""
    quantum = 2 * np.pi / 8
    loop = LoopSettings(gains=GAINS, drive=DRIVE, speed_source=source, difference_window=window)
    wheel, count = WheelLoop(loop, Gearbox(1.0), Encoder(8.0)), 1
    for k in range(400):
        more = counts if k >= 200 and k % 50 == 0 else 0
        count += more
        wheel.speed(STEP, quantum * more / STEP, count, 0.0)
        if k == 200:
            assert wheel.jumps == jumps
    assert bool(wheel.jumps) == bool(jumps)
