# SPDX-License-Identifier: Apache-2.0
"""A load that comes or goes while a motor is recorded hides none of its numbers."""

import independent
import motors
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Hardware, Record

RATE, SECONDS, WINDOW, STATIC = 500, 16, 10, 0.4
R, L, K, J, B = independent.TABLE_1["rear_left"]


def recorded(load, *, counts, seed, least=-9.0, back=SECONDS):
    """Return a motor under a load [of its friction], its speed a mean over ten rows, or counts.

    From ``back`` [s] on it is driven the other way.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(RATE * SECONDS) / RATE
    voltage = np.repeat(rng.uniform(least, 9.0, 100), 83)[: time.size]
    voltage = np.where(time < back, voltage, -voltage)
    friction = STATIC * K / R
    out = independent.simulate(time, voltage, R, L, K, J, B, friction, friction * load, 40)
    if counts:
        count = np.floor(out[:, 2] / motors.QUANTUM).astype(np.int64)
        return Record("motor", time, voltage, count=count, hardware=Hardware(1.0, 500.0))
    angle = np.concatenate([np.zeros(WINDOW), out[:, 2]])
    speed = (angle[WINDOW:] - angle[:-WINDOW]) * RATE / WINDOW
    speed += 0.2 * rng.standard_normal(time.size)
    current = out[:, 0] + 0.01 * rng.standard_normal(time.size)
    return Record("motor", time, voltage, current=current, velocity=speed)


def stepped(at: float) -> np.ndarray:
    return np.where(np.arange(RATE * SECONDS) < at * RATE, 0.0, 0.7)


@pytest.mark.parametrize("at", [4.1, 9.3])
@pytest.mark.parametrize("counts", [False, True])
def test_a_load_that_steps_is_found_and_moves_no_number(counts, at):
    found = estimate(recorded(stepped(at), counts=counts, seed=3))
    (words,) = [f for f in found.findings if f.code == "load_step"]
    assert abs(words.evidence["load_step_at"] * SECONDS - at) < 0.06 * SECONDS
    true = motors.truth("rear_left", STATIC)
    assert not found.unreliable
    names = ["dc_gain", "static_voltage", *(() if counts else ("resistance", "inductance"))]
    motors.check(found, true, names, floor=2e-3, most=0.05)  # the simulator's steps: 1e-3


@pytest.mark.parametrize(("counts", "back"), [(False, SECONDS), (True, SECONDS), (True, 9.4)])
def test_of_a_motor_that_turns_one_way_the_friction_is_not_told_from_loads(counts, back):
    """In one direction all the time, or reversed from the left-out part of the load on."""
    found = estimate(recorded(stepped(9.3), counts=counts, seed=5, least=3.0, back=back))
    motors.check(found, motors.truth("rear_left", STATIC), ["dc_gain"], floor=2e-3)


def test_no_load_is_not_a_step():
    found = estimate(recorded(np.zeros(RATE * SECONDS), counts=False, seed=4))
    assert "load_step" not in {f.code for f in found.findings}


@pytest.mark.parametrize("seed", range(3))
def test_an_angle_that_wanders_under_torque_noise_shows_no_step(seed):
    rng = np.random.default_rng(20 + seed)
    found = estimate(recorded(3.0 * rng.standard_normal(RATE * SECONDS), counts=True, seed=seed))
    codes = {f.code for f in found.findings}
    assert "torque_noise" in codes and "load_step" not in codes
