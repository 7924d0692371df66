# SPDX-License-Identifier: Apache-2.0
"""Effects of drivers, sensors and loads are found without parameter bias."""

from dataclasses import replace

import motors
import numpy as np
import pytest
from independent import TABLE_1, simulate

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Hardware, Record

LEAST = 1.5
"""Command below which a driver puts out nothing [V]."""


@pytest.mark.parametrize("current", [False, True])
def test_driver_dead_zone_is_found_without_parameter_bias(current):
    level = 0.6 * np.random.default_rng(3).integers(-15, 16, 30)
    command = np.repeat(level, 100)
    made = motors.record(current=current, voltage=np.where(np.abs(command) < LEAST, 0.0, command))
    found = estimate(replace(made, voltage=command))
    assert "hard_dead_zone" in [f.code for f in found.findings]
    # No command lies in between, so the threshold is not known better.
    least = found.combinations["least_command"]
    assert 1.2 < least.value < 1.8
    assert 0.05 < least.total_std < 0.6
    assert least.total_ci95[0] < LEAST < least.total_ci95[1]
    truth = motors.truth("rear_left", 0.3)
    for name in ("dc_gain", "time_constant", "static_voltage"):
        assert found.value(name) == pytest.approx(truth[name], rel=2e-3)


@pytest.mark.parametrize("resistance, electrical", [(9.34, 1.91e-3), (4.35, 9.5e-3)])
def test_clean_sine_of_whole_rows_gets_no_effect(resistance, electrical):
    # 400 rows a period: counts round alike in each, and neighbouring commands are almost equal.
    t = np.arange(8001) / 200.0
    voltage = 8.0 * np.sin(2 * np.pi * 0.5 * np.append(0.0, t[:-1]))
    k, friction = 0.0105, 3.3e-4
    x = simulate(t, voltage, resistance, resistance * electrical, k, 3.85e-7, 6e-7, friction,
                 np.zeros(t.size), 2000)  # fmt: skip
    current = x[:, 0] + 0.002 * np.random.default_rng(1).standard_normal(t.size)
    count = np.floor(x[:, 2] * 500 / (2 * np.pi)).astype(np.int64)
    found = estimate(
        Record("motor", t, voltage, current, count=count, hardware=Hardware(1.0, 500.0))
    )
    assert set(found.chain.components) == {"friction", "angle", "electromechanical", "current"}
    assert "misfit" not in [f.code for f in found.findings]


@pytest.mark.parametrize("error", [0.0, 0.003, 0.06])
def test_once_per_turn_encoder_error_is_estimated(error):
    rng = np.random.default_rng(1)
    t = np.arange(4000) / 200
    voltage = np.repeat(rng.uniform(-9.0, 9.0, 100), 40)
    r, inductance, k, j, b = TABLE_1["rear_left"]
    turned = simulate(t, voltage, r, inductance, k, j, b, 0.3 * k / r, 0 * t, 50)[:, 2]
    count = np.floor((turned + error * np.sin(turned + 1.0)) * 2000 / (2 * np.pi)).astype(np.int64)
    found = estimate(Record("motor", t, voltage, count=count, hardware=Hardware(1.0, 2000.0)))
    assert ("encoder_error" in [f.code for f in found.findings]) == (error > 0)
    if error:
        size = found.combinations["encoder_error"]
        assert abs(abs(size.value) - error) < 5 * size.std + 0.01 * error
    truth = motors.truth("rear_left", 0.3)
    motors.check(found, truth, ("dc_gain", "time_constant", "static_voltage"))


COMMAND_RATE = 200.0
FINER = 20  # steps of the driver's clock per sample


def simulate_command_jitter(latest: float, seed: int) -> Record:
    """Return random steps, each delayed by a random time of up to ``latest`` samples."""
    rng = np.random.default_rng(seed)
    asked = np.repeat(rng.uniform(-10.0, 10.0, 200), 10)
    fine = np.repeat(asked, FINER)
    changes = np.flatnonzero(np.diff(fine)) + 1
    given = fine.copy()
    for k, late in zip(changes, rng.integers(0, int(latest * FINER) + 1, changes.size)):
        given[k : k + late] = fine[k - 1]
    t = np.arange(given.size) / (COMMAND_RATE * FINER)
    out = simulate(t, given, *TABLE_1["rear_left"], 0.0, np.zeros(t.size), 4)
    rows = np.arange(FINER - 1, given.size, FINER)  # held over the interval before
    speed = out[rows, 1] + 0.2 * rng.standard_normal(rows.size)
    return Record("rear_left", t[rows] - t[rows[0]], asked, velocity=speed)


def test_command_jitter_is_covered_by_the_total_uncertainty():
    for found in (estimate(simulate_command_jitter(1.0, seed)) for seed in range(3)):
        names = ("dc_gain", "time_constant", "time_constant_product")
        motors.check(found, motors.truth("rear_left", 0.0), names, sigmas=3.5, total=True)


def test_fixed_delay_is_kept_under_command_jitter():
    found = estimate(simulate_command_jitter(1.0, 0), fixed={"delay": 0.5 / COMMAND_RATE})
    assert found.combinations["delay"].value == 0.5 / COMMAND_RATE
    truth = motors.truth("rear_left", 0.0)
    motors.check(found, truth, ["time_constant"], sigmas=3.5, total=True)


RATE, SECONDS, WINDOW, STATIC = 500, 16, 10, 0.4
R, L, K, J, B = TABLE_1["rear_left"]


def simulate_load(load, *, counts, seed, least=-9.0, back=SECONDS):
    """Return a record under a load relative to friction, with averaged speed or counts.

    The voltage is reversed from ``back`` [s] on.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(RATE * SECONDS) / RATE
    voltage = np.repeat(rng.uniform(least, 9.0, 100), 83)[: time.size]
    voltage = np.where(time < back, voltage, -voltage)
    friction = STATIC * K / R
    out = simulate(time, voltage, R, L, K, J, B, friction, friction * load, 40)
    if counts:
        count = np.floor(out[:, 2] / motors.QUANTUM).astype(np.int64)
        return Record("motor", time, voltage, count=count, hardware=Hardware(1.0, 500.0))
    angle = np.concatenate([np.zeros(WINDOW), out[:, 2]])
    speed = (angle[WINDOW:] - angle[:-WINDOW]) * RATE / WINDOW
    speed += 0.2 * rng.standard_normal(time.size)
    current = out[:, 0] + 0.01 * rng.standard_normal(time.size)
    return Record("motor", time, voltage, current=current, velocity=speed)


def make_load_step(at: float) -> np.ndarray:
    return np.where(np.arange(RATE * SECONDS) < at * RATE, 0.0, 0.7)


@pytest.mark.parametrize("at", [4.1, 9.3])
@pytest.mark.parametrize("counts", [False, True])
def test_step_load_is_found_without_parameter_bias(counts, at):
    found = estimate(simulate_load(make_load_step(at), counts=counts, seed=3))
    (words,) = [f for f in found.findings if f.code == "load_step"]
    assert abs(words.evidence["load_step_at"] * SECONDS - at) < 0.06 * SECONDS
    true = motors.truth("rear_left", STATIC)
    assert not found.unreliable
    names = ["dc_gain", "static_voltage", *(() if counts else ("resistance", "inductance"))]
    motors.check(found, true, names, floor=2e-3, most=0.05)  # error of the simulator's steps: 1e-3


@pytest.mark.parametrize(("counts", "back"), [(False, SECONDS), (True, SECONDS), (True, 9.4)])
def test_step_load_does_not_bias_the_gain_of_a_motor_turning_one_way(counts, back):
    """Driven in one direction throughout, or reversed shortly after the load step."""
    found = estimate(
        simulate_load(make_load_step(9.3), counts=counts, seed=5, least=3.0, back=back)
    )
    motors.check(found, motors.truth("rear_left", STATIC), ["dc_gain"], floor=2e-3)


def test_load_step_is_not_reported_without_a_load():
    found = estimate(simulate_load(np.zeros(RATE * SECONDS), counts=False, seed=4))
    assert "load_step" not in {f.code for f in found.findings}


@pytest.mark.parametrize("seed", range(3))
def test_torque_noise_is_not_reported_as_a_load_step(seed):
    rng = np.random.default_rng(20 + seed)
    found = estimate(
        simulate_load(3.0 * rng.standard_normal(RATE * SECONDS), counts=True, seed=seed)
    )
    codes = {f.code for f in found.findings}
    assert "torque_noise" in codes and "load_step" not in codes
