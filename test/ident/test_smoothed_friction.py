"""A motor that a loop holds near rest while its load fluctuates shows less friction than it has."""

import math

import numpy as np
import pytest
from test_disturbance import COUNTS, GAIN, STATIC, STEP, TAU, moved

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Hardware, Record

ROWS = 3_000
NOISE = 1.0  # V, of each row


def in_a_loop(seed: int) -> Record:
    """Return counts of a motor of first order that a PI controller drives, and often rests."""
    rng = np.random.default_rng(seed)
    wanted = np.repeat(rng.uniform(-60.0, 60.0, ROWS // 150), 150)
    wanted[np.repeat(rng.uniform(size=ROWS // 150) < 0.5, 150)] = 0.0
    load = NOISE * rng.standard_normal(ROWS)
    voltage, count, speed, angle, integral = np.zeros(ROWS), np.zeros(ROWS), 0.0, 0.0, 0.0
    for k in range(1, ROWS):
        left = STEP
        while left > 0.0:
            speed, turned, left = moved(speed, voltage[k - 1] - load[k], left)
            angle += turned
        count[k] = math.floor(angle * COUNTS / (2 * math.pi))
        error = wanted[k] - (count[k] - count[k - 1]) * 2 * math.pi / COUNTS / STEP
        integral += 0.3 * STEP * error
        voltage[k] = 0.03 * error + integral
    hardware = Hardware(counts_per_revolution=COUNTS)
    time = STEP * np.arange(ROWS)
    given = np.append(voltage[0], voltage[:-1])  # what acted up to a row
    return Record("motor", time, given, count=count.astype(np.int64), hardware=hardware)


@pytest.mark.parametrize("seed", range(3))
def test_friction_that_a_load_smooths_is_in_the_interval(seed):
    found = estimate(in_a_loop(seed))
    truth = {"dc_gain": GAIN, "time_constant": TAU, "static_voltage": STATIC}
    for name, value in truth.items():
        quantity = found.combinations[name]
        # a move that is one standard deviation, and twice chance
        assert abs(quantity.value - value) < 2.5 * quantity.std
    (words,) = [f for f in found.findings if f.code == "smoothed_friction"]
    assert words.evidence["static_voltage"] > found.combinations["static_voltage"].value
