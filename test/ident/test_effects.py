# SPDX-License-Identifier: Apache-2.0
"""Effects of drivers, sensors, loads and logged commands are found without parameter bias."""

from dataclasses import replace

import motors
import numpy as np
import pytest
from motors import TABLE_1, excitation, simulate
from scipy.signal import lsim

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record

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
    found = estimate(motors.counted(t, voltage, x[:, 2], current=current))
    assert set(found.chain.components) == {"friction", "angle", "electromechanical", "current"}
    assert "misfit" not in [f.code for f in found.findings]


@pytest.mark.parametrize("error", [0.0, 0.003, 0.06])
def test_once_per_turn_encoder_error_is_estimated(error):
    rng = np.random.default_rng(1)
    t = np.arange(4000) / 200
    voltage = np.repeat(rng.uniform(-9.0, 9.0, 100), 40)
    r, inductance, k, j, b = TABLE_1["rear_left"]
    turned = simulate(t, voltage, r, inductance, k, j, b, 0.3 * k / r, 0 * t, 50)[:, 2]
    shown = turned + error * np.sin(turned + 1.0)
    found = estimate(motors.counted(t, voltage, shown, 2000.0))
    assert ("encoder_error" in [f.code for f in found.findings]) == (error > 0)
    if error:
        size = found.combinations["encoder_error"]
        assert abs(abs(size.value) - error) < 5 * size.std + 0.01 * error
    truth = motors.truth("rear_left", 0.3)
    motors.check(found, truth, ("dc_gain", "time_constant", "static_voltage"))


REAR_LEFT = TABLE_1["rear_left"]


def low_pass_speed(
    ratio: float, friction: float = 0.3, inductance: float = REAR_LEFT[1], one_size: bool = False
) -> tuple[Record, float]:
    """Return a record of a speed behind a low-pass, and its lag [s]: a multiple of the motor's."""
    t = np.arange(3000) / 200
    steps = np.random.default_rng(2).uniform(-9.0, 9.0, 60)
    voltage = np.repeat(8.5 * np.sign(steps) if one_size else steps, 50)
    r, _, k, j, b = REAR_LEFT
    speed = simulate(t, voltage, r, inductance, k, j, b, friction * k / r, 0 * t, 10)[:, 1]
    lag = ratio * motors.truth("rear_left", friction)["time_constant"]
    shown = lsim(([1.0], [lag, 1.0]), speed, t)[1]
    shown += 0.2 * np.random.default_rng(3).standard_normal(t.size)
    return Record("motor", t, voltage, velocity=shown), lag


@pytest.mark.parametrize("ratio", [0.2, 4.0])
def test_low_pass_of_the_speed_is_told_from_the_motor_by_friction(ratio):
    record, _ = low_pass_speed(ratio)
    found, truth = estimate(record), motors.truth("rear_left", 0.3)
    assert "low_passed_speed" in found.chain.components
    assert "dead_zone" not in found.chain.components
    motors.check(found, truth, ("dc_gain", "time_constant", "static_voltage"))
    assert found.value("time_constant") == pytest.approx(truth["time_constant"], rel=0.03)


def test_low_pass_of_the_speed_is_told_from_the_motor_where_nothing_else_is_promising():
    record, lag = low_pass_speed(4.0, inductance=1e-3, one_size=True)
    found = estimate(record)
    assert found.chain.values["sensor_lag"] == pytest.approx(lag, rel=0.02)
    motors.check(found, motors.truth("rear_left", 0.3), ["static_voltage"])


def test_given_low_pass_of_the_speed_does_not_exchange_its_lag_with_the_motor():
    # Without friction and a lag of the winding nothing tells one lag from the other.
    record, lag = low_pass_speed(4.0, friction=0.0, inductance=1e-3)
    found = estimate(record, fixed={"sensor_lag": lag}).combinations["time_constant"]
    r, _, k, j, b = REAR_LEFT
    assert found.value == pytest.approx((r * j + 1e-3 * b) / (r * b + k * k), rel=3e-3)
    assert "low_passed_speed" not in [share.cause for share in found.systematic]
    assert found.total_std < 0.2 * found.value


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


def simulate_load(load, *, counts, seed, least=-9.0, back=SECONDS):
    """Return a record under a load relative to friction, with averaged speed or counts.

    The voltage is reversed from ``back`` [s] on.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(RATE * SECONDS) / RATE
    voltage = np.repeat(rng.uniform(least, 9.0, 100), 83)[: time.size]
    voltage = np.where(time < back, voltage, -voltage)
    motor = TABLE_1["rear_left"]
    friction = STATIC * motor[2] / motor[0]
    out = simulate(time, voltage, *motor, friction, friction * load, 40)
    if counts:
        return motors.counted(time, voltage, out[:, 2])
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


R, L, K, J, B, TC = 2.0, 2.4e-3, 0.03, 2.0e-5, 1.0e-5, 2.0e-3
BELOW = K**2 + R * B
TRUTH = {
    "dc_gain": K / BELOW,
    "time_constant": (R * J + L * B) / BELOW,
    "time_constant_product": L * J / BELOW,
    "static_voltage": R * TC / K,
}


def assert_covered(record: Record, truth: dict[str, float]) -> None:
    """Assert that the true values are within the stated uncertainty of an estimate."""
    found = estimate(record).combinations
    for name, true in truth.items():
        q = found[name]
        if q.value is not None and q.std is not None:
            # 5 standard deviations count as a silent error; friction has 0.5 % of 9 V in addition.
            floor = 0.045 if name == "static_voltage" else 1e-3 * true
            assert abs(q.value - true) < max(5 * q.total_std, floor), (name, q.value, q.std, true)


@pytest.mark.parametrize("current", [False, True])
def test_delay_is_estimated_when_commands_are_logged_one_row_late(current):
    """A smooth command has no edges that reveal the one-row shift."""
    rng = np.random.default_rng(6)
    t = np.arange(3000) / 100
    tones = rng.uniform(0.1, 2.0, 8)
    v = 2.5 * np.sin(2 * np.pi * np.outer(t, tones) + rng.uniform(0, 6, 8)).sum(axis=1)
    out = simulate(t, v, R, L, K, J, B, TC, np.zeros(t.size), 100)
    amps = out[:, 0] + 0.02 * rng.standard_normal(t.size) if current else None
    late = np.concatenate([v[:1], v[:-1]])
    found = estimate(motors.counted(t, late, out[:, 2], current=amps))
    assert not found.unreliable
    assert found.value("delay") == pytest.approx(-0.01, abs=3e-4)
    motors.check(found, TRUTH, ("dc_gain", "time_constant", "static_voltage"), most=0.02)


@pytest.mark.parametrize("kind", ["square", "fourier", "sine"])
def test_delay_is_estimated_when_commands_are_logged_one_row_early(kind):
    t = np.arange(3000) / 200
    v = excitation(t, kind, 9.0)
    ran = np.concatenate([v[:1], v[:-1]])  # over the interval that ends at each row
    out = simulate(t, ran, R, L, K, J, B, TC, np.zeros(t.size), 100)
    record = motors.counted(t, v, out[:, 2])
    assert_covered(record, TRUTH)
    delay = estimate(record).combinations["delay"]
    assert abs(delay.value - 1 / 200) < 4 * delay.std < 2e-3


def test_time_constant_interval_covers_truth_if_electrical_lag_is_one_sample():
    t = np.arange(8000) / 1000
    v = 9.0 * np.interp((t / 2.0) % 4.0, [0.0, 1.0, 3.0, 4.0], [0.0, 1.0, -1.0, 0.0])
    out = simulate(t, v, R, R / 1000, K, J, B, TC, np.zeros(t.size), 100)
    found = estimate(motors.counted(t, v, out[:, 2]))
    lag = found.combinations["time_constant"]
    assert lag.total_ci95[0] < (R * J + R / 1000 * B) / (R * B + K * K) < lag.total_ci95[1]


@pytest.mark.parametrize("seed", range(3))
def test_first_order_hold_of_the_command_does_not_bias_the_estimate(seed):
    rng = np.random.default_rng(seed)
    t = np.arange(3000) / 100
    tones = (0.3, 0.7, 1.3, 2.9, 5.1)
    v = 3.0 * sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in tones)
    slow = 10 * TRUTH["time_constant"], 100 * TRUTH["time_constant_product"]
    motor = [TRUTH["dc_gain"]], [slow[1], slow[0], 1.0]
    _, speed, _ = lsim(motor, v, t)  # a first-order hold, as by default
    speed = speed + 0.05 * rng.standard_normal(t.size)
    truth = {"dc_gain": motor[0][0], "time_constant": slow[0], "time_constant_product": slow[1]}
    assert_covered(Record("motor", t, v, velocity=speed), truth)


def late_record(seed, tones, rate, samples, per_turn, late=None):
    """Return counts of a motor under tones, delayed by 0 to 0.9 samples."""
    rng = np.random.default_rng(seed)
    drawn = int(rng.integers(0, 10)) if rng.random() < 0.5 else 0
    late = drawn if late is None else late
    t = np.arange(samples) / rate
    v = sum(rng.uniform(1, 3) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in tones)
    r, el, k, j, b = TABLE_1["rear_left"]
    return late_counts(rng, v, rate, per_turn, late, (r, el, k, j, b, 0.3 * k / r))


def late_counts(rng, v, rate, per_turn, late, motor, noise=None):
    """Return counts of a motor whose commands act ``late`` tenths of a sample late.

    The current is included if its ``noise`` [A] is given.
    """
    samples = v.size
    t = np.arange(samples) / rate
    ran = np.concatenate([np.full(1 + late, v[0]), np.repeat(v[1:], 10)])[: 10 * (samples - 1) + 1]
    fine = np.arange(ran.size) / (10 * rate)
    out = simulate(fine, ran, *motor, np.zeros(ran.size), 10)[::10]
    angle = out[:, 2] + rng.uniform() * 2 * np.pi / per_turn
    current = None if noise is None else out[:, 0] + noise * rng.standard_normal(samples)
    return motors.counted(t, v, angle, per_turn, current)


@pytest.mark.parametrize("late", [3, 4])
def test_a_fractional_delay_of_a_command_is_estimated(late):
    tones = (0.5, 1.1, 2.3, 5.3, 11.0, 19.0)
    record = late_record(1, tones, 200, 1000, 500.0, late)
    known = motors.truth("rear_left", 0.3)
    assert_covered(record, {name: known[name] for name in TRUTH})
    assert estimate(record).value("delay") == pytest.approx(late / 10 / 200, abs=0.02 / 200)


@pytest.mark.parametrize("seed", [0, 3, 5])
def test_half_sample_delay_under_ramps_does_not_bias_the_lags(seed):
    """Command switches in mid-interval are confounded with such a delay."""
    motor = 13.6, 3.2e-3, 0.014, 7.5e-7, 3.2e-6, 4.4e-4
    rng = np.random.default_rng(seed)
    corners, length = np.cumsum(rng.uniform(0.3, 2.5, 12)), int(rng.integers(4, 13))
    corners = np.sort(np.concatenate([corners, corners + length / 200]))
    levels = np.repeat(rng.uniform(1.2, 3.5, 13), 2)[1:-1]
    v = np.interp(np.arange(1900) / 200, corners, levels)
    v[0] = 0.0
    r, el, k, j, b, tc = motor
    below = k * k + r * b
    lags = {"time_constant": (r * j + el * b) / below, "time_constant_product": el * j / below}
    record = late_counts(rng, v, 200, 2000.0, 5, motor)
    assert_covered(record, {"dc_gain": k / below, **lags, "static_voltage": r * tc / k})


def test_lag_interval_covers_subsample_delay_hidden_by_slow_commands():
    """Coarse counts separate delay and second lag only to a fraction of a sample."""
    known, errors = motors.truth("rear_left", 0.3), []
    for seed in range(20):
        found = estimate(late_record(seed, (0.2, 0.5, 1.1, 2.3), 500, 5000, 28.0)).combinations
        lag = found["time_constant"]
        errors.append((lag.value - known["time_constant"]) / lag.total_std)
    assert np.abs(errors).max() < 4


def test_initial_state_of_held_out_data_is_estimated():
    rng = np.random.default_rng(5)
    t = np.arange(3000) / 1000
    v = np.repeat(rng.uniform(2.0, 9.0, 100), 30)
    out = simulate(t, v, R, 4e-5 * R, K, J, 0.0, 1.5e-2, np.zeros(t.size), 100)
    found = estimate(motors.counted(t, v, out[:, 2], 2000.0))
    assert found.fit_percent.validation > 97
    assert "validation" not in [f.code for f in found.findings]


@pytest.mark.parametrize("seed", range(3))
def test_time_constant_interval_covers_delay_confounded_with_electrical_lag(seed):
    """At 10 ms sampling only the sum of L/R (0.5 ms) and delay (3 ms) is identifiable."""
    rng = np.random.default_rng(seed)
    r, el, k, b, lag = 1.0, 5e-4, 0.5, 0.0125, 0.206
    below = k * k + r * b
    v = sum(
        np.sin(2 * np.pi * f * np.arange(1100) / 100 + rng.uniform(0, 6))
        for f in np.exp(rng.uniform(np.log(0.08), np.log(2.3), 7))
    )
    record = late_counts(rng, 2.5 * v, 100, 4758.0, 3, (r, el, k, lag * below / r, b, 0.18))
    found = estimate(record).combinations
    sum_of_both = lag + el * b / below
    for true in (sum_of_both, sum_of_both - el / r):
        assert abs(found["time_constant"].value - true) < 4 * found["time_constant"].total_std
    assert found["time_constant"].total_std < 0.05 * lag


@pytest.mark.parametrize("late", [42, 21])
def test_delay_just_beyond_a_whole_sample_does_not_bias_the_inductance(late):
    """The likelihood has a kink at each whole sample and a local optimum on either side."""
    rng = np.random.default_rng(0)
    t = np.arange(6000) / 200
    v = 6.0 * np.sin(2 * np.pi * (0.07 * t + 1.4 / t[-1] * t**2))
    motor = 0.188, 1.76e-4, 0.018, 3.9e-4, 1.8e-4, 0.07
    record = late_counts(rng, v, 200, 500.0, late, motor, 0.13)
    found = estimate(record)
    # 4 standard deviations: one in 16,000; the kink hid a tenth of a sample, and doubled L.
    motors.check(found, {"delay": late / 10 / 200, "inductance": 1.76e-4}, total=True)
