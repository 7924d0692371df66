# SPDX-License-Identifier: Apache-2.0
"""Poor but common records give combinations of parameters; rest adds no information."""

from dataclasses import replace

import motors
import numpy as np
import pytest
from motors import simulate
from scipy.signal import lfilter

from smp_motor_ident.errors import InsufficientExcitationError, SignalError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.fit.data import prepare, speed_quantum
from smp_motor_ident.infer.validation import compute_fit_percent
from smp_motor_ident.infer.validation import simulate as simulate_freely
from smp_motor_ident.quality.excitation import find_excitation
from smp_motor_ident.quality.lag import apply_lag
from smp_motor_ident.quality.resolution import MIN_REST_SAMPLES
from smp_motor_ident.record import Hardware, Record

TRUTH = {"dc_gain": 15.0, "time_constant": 0.12, "static_voltage": 2.0}


def _record(voltage: np.ndarray, rate: float = 500.0, noise: float = 0.5) -> Record:
    """Return the exact first-order response with Coulomb friction in one direction, and noise."""
    gain, tau, friction = TRUTH.values()
    rng = np.random.default_rng(3)
    keep = np.exp(-1 / rate / tau)
    w = np.zeros(voltage.size)
    for k in range(1, voltage.size):
        ahead = keep * w[k - 1] + (1 - keep) * gain * (voltage[k] - friction)
        w[k] = max(ahead, 0.0)  # it stops within the interval; the fraction is below the noise
    t = np.arange(voltage.size) / rate
    return Record("motor", t, voltage, velocity=w + noise * rng.standard_normal(t.size))


@pytest.mark.parametrize("rest", [0, 200])
def test_one_voltage_level_identifies_only_the_steady_speed(rest):
    record = _record(np.r_[np.zeros(rest), np.full(600, 8.0)])
    if rest == 0:  # the first row is the step from rest
        assert np.ptp(record.voltage) == 0.0
    found = estimate(record)
    for name in ("dc_gain", "static_voltage"):
        q = found.combinations[name]
        low, high = q.total_ci95 or q.ci95
        assert low <= TRUTH[name] <= high and high - low > 0.5 * TRUTH[name]
    steady = found.combinations["steady_speed"]
    # 4 standard deviations: one in 16,000.
    assert abs(steady.value - 15.0 * (8.0 - 2.0)) < 4 * steady.std
    assert steady.std < 1.0
    assert [f.evidence["voltage"] for f in found.findings if f.code == "one_level"] == [8.0]
    measured, simulated = simulate_freely(found, record)
    assert compute_fit_percent(measured, simulated) > 90


def test_lag_uncertainty_covers_the_breakaway_delay_of_one_step():
    # From rest the winding first builds up the torque that friction holds: 0.6 V of 8 V are a
    # delay of 1.5 ms, confounded with another inductance without friction.
    step = np.r_[np.zeros(100), np.full(900, 8.0)]
    record = motors.record(
        "rear_left", current=False, voltage=step, kinds=("x",), rate=1000.0, static_voltage=0.6
    )
    lags = ("time_constant", "time_constant_product")
    motors.check(estimate(record), motors.truth("rear_left", 0.6), lags, total=True, most=0.5)


def test_two_voltage_levels_separate_gain_and_friction():
    found = estimate(_record(np.r_[np.zeros(100), np.full(400, 8.0), np.full(400, 4.0)]))
    motors.check(found, TRUTH, ("dc_gain", "static_voltage"))
    assert "steady_speed" not in found.combinations
    # In one direction a load is confounded with friction.
    assert "one_direction" in [f.code for f in found.findings if f.severity == "warning"]


def test_incremental_gain_below_static_gain_is_reported_as_load_or_driver_effect():
    """The incremental gain of 8 rad/s/V is below the static gain of 15 rad/s/V."""
    level = 4.0 + np.where(np.arange(2000) // 100 % 2, 0.5, -0.5)
    t = np.arange(level.size) / 500.0
    changes = lfilter([1 - np.exp(-1 / 60)], [1, -np.exp(-1 / 60)], level - 4.0)
    noise = 0.5 * np.random.default_rng(5).standard_normal(t.size)
    found = estimate(Record("motor", t, level, velocity=15.0 * 4.0 + 8.0 * changes + noise))
    # A driver that lets the motor coast, or that clips, does the same.
    assert {"driving_load", "coast", "clip"} & {
        f.code for f in found.findings if f.severity != "note"
    }


def test_an_impossible_motor_is_reported():
    good = motors.record("rear_left", current=False, seconds=3.0)
    codes = {}
    for scale in (1.0, 1000.0):
        found = estimate(replace(good, time=scale * good.time, velocity=None))
        codes[scale] = [f.code for f in found.findings]
    assert "implausible_motor" in codes[1000.0] and "implausible_motor" not in codes[1.0]


@pytest.mark.parametrize(
    "speed, volts, code",
    [(1.0, 1.0, None), (60 / (2 * np.pi), 1.0, "fast_motor"), (1.0, 0.05, "implausible_motor")],
)
def test_speed_in_rpm_or_command_in_amperes_is_reported_as_implausible(speed, volts, code):
    """The motor turns 6,300 rpm at 24 V; a command in A is a twentieth of the voltage in V."""
    good = motors.record("rear_left", current=False, seconds=3.0)
    turned = speed * good.count * motors.QUANTUM
    hardware = replace(good.hardware, supply_voltage=24.0)
    record = Record("m", good.time, volts * good.voltage, position=turned, hardware=hardware)
    codes = {f.code for f in estimate(record).findings}
    assert codes & {"fast_motor", "implausible_motor"} == ({code} if code else set())


def test_rest_before_the_excitation_does_not_change_the_estimate():
    driven = motors.record("rear_left", current=False, seconds=3.0)
    n = 4000
    t = np.arange(n + len(driven)) / 200.0
    volts = np.r_[np.zeros(n + 1), driven.voltage[1:]]  # held over the interval before
    rested = replace(driven, time=t, voltage=volts, velocity=np.r_[np.zeros(n), driven.velocity],
                     count=np.r_[np.full(n, driven.count[0]), driven.count])  # fmt: skip
    with_it, without = estimate(rested), estimate(driven)
    assert with_it.model == without.model
    for name in ("dc_gain", "time_constant", "static_voltage"):
        a, b = with_it.combinations[name], without.combinations[name]
        assert abs(a.value - b.value) < b.std, name


def test_angle_noise_at_rest_is_not_detected_as_motion():
    driven = motors.record("rear_left", current=False, seconds=3.0)
    n, rng = 9000, np.random.default_rng(3)
    turn = 2 * np.pi / driven.hardware.counts_per_revolution
    moved = np.r_[np.zeros(n), (driven.count - driven.count[0]) * turn]
    scatter = 0.1 * np.abs(np.diff(moved)).max()
    position = moved + scatter * rng.standard_normal(moved.size)
    time, volts = np.arange(moved.size) / 200.0, np.r_[np.zeros(n), driven.voltage]
    rested = replace(driven, time=time, voltage=volts, velocity=None, count=None, position=position)
    assert np.diff(find_excitation(rested))[0] < 1.1 * len(driven)
    found = estimate(rested).combinations["dc_gain"]
    truth = estimate(driven).combinations["dc_gain"]
    assert abs(found.value - truth.value) < 3 * found.std


def make_staircase_record(lag: float, scatter: float) -> Record:
    """Return a speed at 1 Hz of a motor of gain 20 with friction of 0.5 V under 30 levels."""
    rng = np.random.default_rng(4)
    voltage = np.repeat(rng.uniform(-10.0, 10.0, 30), 10)
    steady = 20.0 * (voltage - np.clip(voltage, -0.5, 0.5))
    keep = np.exp(-1.0 / lag)
    speed = lfilter([1 - keep], [1.0, -keep], steady)
    noisy = speed + scatter * rng.standard_normal(speed.size)
    return Record("motor", np.arange(voltage.size) * 1.0, voltage, velocity=noisy)


def test_gain_is_estimated_if_the_lag_is_below_the_sampling_interval():
    found = estimate(make_staircase_record(0.05, 5.0))
    lag, gain = (found.combinations[n] for n in ("time_constant", "dc_gain"))
    assert abs(lag.value - 0.05) < 2 * lag.total_std and lag.total_std > 0.05
    assert abs(gain.value - 20.0) < 3 * gain.std < 1.0
    assert estimate(make_staircase_record(1.0, 5.0)).combinations["time_constant"].value is not None


def test_angle_mapped_as_velocity_is_refused_with_advice():
    rng = np.random.default_rng(11)
    rate, turns = 50.0, np.array([0.6, 0.0, -0.7, 0.0, 0.5, -0.6])
    voltage = 2.5 * np.repeat(turns, 60) + 0.2 * np.repeat(rng.standard_normal(72), 5)
    speed = _record(np.abs(voltage) + 2.0, rate, 0.0).velocity * np.sign(voltage)
    angle = np.cumsum(speed) / rate
    t = np.arange(voltage.size) / rate
    noisy = angle + 0.01 * rng.standard_normal(t.size)
    with pytest.raises(SignalError, match="map it as position"):
        estimate(Record("motor", t, voltage, velocity=noisy))


def test_time_constant_is_estimated_from_one_step_of_coarse_counts():
    # 64 counts a turn at 5 kHz: at most one count per sample.
    t = np.arange(15000) / 5000.0
    gain, tau, net = 17.5, 0.015, 6.6
    angle = gain * net * (t - tau * (1 - np.exp(-t / tau)))
    count = np.floor(angle * 64 / (2 * np.pi) + 0.3).astype(np.int64)
    hardware = Hardware(1.0, 64.0, 0, 9.0, None)
    voltage = np.r_[0.0, np.full(t.size - 1, 6.9)]
    found = estimate(Record("motor", t, voltage, count=count, hardware=hardware))
    # A second lag, which one step hardly shows, is part of the systematic uncertainty.
    motors.check(found, {"time_constant": tau}, sigmas=1.0, most=0.1, total=True)
    assert found.value("time_constant") == pytest.approx(tau, rel=0.02)
    assert not found.unreliable


def test_constant_load_does_not_bias_gain_and_friction():
    # A square of 3.7 V, load of half the friction and a delay of a seventh of a sample: first
    # order with both, solved exactly between the changes of voltage and of direction.
    gain, tau, friction, load, rate = 67.0, 0.023, 0.14, 0.08, 200.0
    fine = 100
    t = np.arange(760 * fine) / rate / fine
    v = np.where(np.sin(2 * np.pi * 3.1 * (t[::fine] + 0.01)) > 0, 3.7, -3.7)
    given = np.r_[np.zeros(fine // 7), np.repeat(v, fine)][: t.size]
    keep, w, angle, out = np.exp(-1 / rate / fine / tau), 0.0, 0.0, []
    for volt in given:
        out.append(angle)
        w = keep * w + (1 - keep) * gain * (volt - load - friction * np.sign(w or volt))
        angle += w / rate / fine
    rng = np.random.default_rng(2)
    position = np.array(out[::fine]) + 1e-3 * rng.standard_normal(v.size)
    held = np.r_[0.0, v[:-1]]  # voltage of the interval before each row
    found = estimate(Record("motor", t[::fine], held, position=position))
    # 4 standard deviations (one in 16,000), plus the error of the test's grid
    motors.check(found, {"dc_gain": gain, "static_voltage": friction}, floor=2e-3)


@pytest.mark.parametrize(("second_tone", "said"), [(0.0, True), (2.0, False)])
def test_single_sine_is_reported_as_one_voltage_amplitude(second_tone, said):
    rate = 200.0
    t = np.arange(2000) / rate
    voltage = 6.0 * np.sin(2 * np.pi * 1.1 * t) + second_tone * np.sin(2 * np.pi * 3.7 * t)
    keep = np.exp(-1 / rate / TRUTH["time_constant"])
    w = lfilter([0.0, (1 - keep) * TRUTH["dc_gain"]], [1.0, -keep], voltage)
    noisy = w + 0.3 * np.random.default_rng(13).standard_normal(w.size)
    found = estimate(Record("motor", t, np.r_[0.0, voltage[:-1]], velocity=noisy))
    assert ("one_size_of_voltage" in [f.code for f in found.findings]) is said


def test_friction_uncertainty_covers_a_driver_voltage_drop_in_one_direction():
    r, el, k, j, b, tc, drop = 3.4, 1.5e-3, 0.026, 2.3e-5, 4e-5, 7e-4, 0.06
    rng = np.random.default_rng(3)
    t = np.arange(4000) / 500
    v = np.repeat(rng.uniform(2.0, 6.0, 80), 50)
    out = simulate(t, v, r, el, k, j, b, tc, np.zeros(t.size), 40)
    current = out[:, 0] + 0.004 * rng.standard_normal(t.size)
    angle = out[:, 2] + 1e-3 * rng.standard_normal(t.size)
    found = estimate(Record("motor", t, v + drop, current, position=angle))
    # 5 standard deviations count as a silent error.
    motors.check(found, {"coulomb_friction": tc}, sigmas=5.0, total=True)


@pytest.mark.parametrize("sharp", [False, True])
def test_stiction_under_a_ramp_is_not_estimated_as_delay(sharp):
    """Breakaway at 1.5 V, friction of 0.5 V: a ramp starts 0.3 s late. A step has a true delay."""
    rng = np.random.default_rng(0)
    t = np.arange(4000) / 1000
    volts = 3.2 * t if not sharp else np.where(t % 1.0 > 0.5, 9.0, 0.0)
    late = 200 if sharp else 0
    heard = np.concatenate([np.zeros(late), volts[: t.size - late]])
    w = np.zeros(t.size)
    for k in range(1, t.size):
        holds = 1.5 if w[k - 1] == 0 and not sharp else 0.5
        driven = heard[k] > holds or w[k - 1] > 0
        keep = np.exp(-1e-3 / 0.012)
        w[k] = max(keep * w[k - 1] + (1 - keep) * 20.0 * (heard[k] - 0.5), 0.0) if driven else 0.0
    found = estimate(Record("motor", t, volts, velocity=w + 0.3 * rng.standard_normal(t.size)))
    said = {f.code: f.severity for f in found.findings}
    if sharp:
        assert found.value("delay") == pytest.approx(0.2, abs=2e-3)
    else:
        assert found.unreliable or found.value("delay") < 0.036, said


RATE = 2000.0
TIME = np.arange(int(6 * RATE)) / RATE
CHIRP = 10.0 * np.sin(2 * np.pi * (0.3 * TIME + 6.0 * TIME**2))  # to 72 Hz: small amplitude


def make_weakened_record(volts: np.ndarray, share: float, rate: float) -> Record:
    """Return counts of a motor whose voltage is scaled by ``share`` in the last 30 %."""
    late = np.arange(volts.size) >= 0.7 * volts.size
    given = np.where(late, share * volts, volts)
    made = motors.record("rear_left", current=False, voltage=given, rate=rate)
    return replace(made, voltage=volts, velocity=None)


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_validation_accounts_for_the_sensor_resolution(share):
    if share == 1.0:  # a tail of a few counts is predicted to a count
        found = estimate(make_weakened_record(CHIRP, 1.0, RATE))
    else:
        volts = motors.excitation(np.arange(2000) / 200.0, "square", 10.0)
        found = estimate(make_weakened_record(volts, share, 200.0))
    codes = {f.code: f.severity for f in found.findings}
    assert ("validation" in codes or "supply_drift" in codes) == (share < 1.0)


def make_count_record(counts: list[int], starts: tuple[int, ...] = (0,)) -> Record:
    count = np.array(counts)
    time = 0.01 * np.arange(count.size)
    hardware = Hardware(1.0, 500.0)
    return Record("w", time, np.ones(count.size), count=count, starts=starts, hardware=hardware)


def find_kept_samples(record: Record) -> list[int]:
    """Return the indices at which the angle is an output."""
    return [int(k) for k in np.flatnonzero(np.isfinite(prepare([record], False).motion))]


def test_only_the_middle_sample_of_a_standstill_is_kept():
    moving, still = list(range(20)), [20] * 31
    assert find_kept_samples(make_count_record([*moving, *still, *range(21, 30)])) == [
        *range(20),
        35,
        *range(51, 60),
    ]


def test_a_segment_that_begins_at_rest_keeps_its_first_sample():
    counts = [0] * 30 + list(range(1, 11)) + [7] * 30 + list(range(8, 12))
    assert find_kept_samples(make_count_record(counts, (0, 40))) == [
        0,
        *range(30, 40),
        40,
        *range(70, 74),
    ]


def test_slow_motion_keeps_all_samples():
    slow = [k // (MIN_REST_SAMPLES - 1) for k in range(90)]
    assert find_kept_samples(make_count_record(slow)) == list(range(90))


@pytest.mark.parametrize("rest", [MIN_REST_SAMPLES, 10 * MIN_REST_SAMPLES])
def test_duration_of_a_standstill_does_not_add_samples(rest):
    assert len(find_kept_samples(make_count_record([0, 1, 2, *[3] * rest, 4, 5]))) == 6


def test_a_motor_at_rest_with_a_noisy_angle_is_refused_despite_its_current():
    resistance, inductance, step = 4.0, 0.02, 0.01
    rng = np.random.default_rng(3)
    voltage = np.repeat(rng.choice([-0.1, 0.0, 0.1], 40), 15)
    current = motors.first_order(voltage, 1 / resistance, inductance / resistance, step)
    position = 1e-3 * rng.standard_normal(voltage.size)
    noisy = current + 1e-4 * rng.standard_normal(voltage.size)
    record = Record("w", step * np.arange(voltage.size), voltage, noisy, position=position)
    with pytest.raises(InsufficientExcitationError, match="the motor is at rest"):
        estimate(record)


def test_gain_from_one_step_is_unidentifiable_or_within_its_uncertainty():
    """A step from rest identifies only the gain times the voltage above friction."""
    gain, tau, friction = 11.45, 0.1967, 0.294
    t = np.arange(60) / 20.0
    voltage = np.where(t > 0.5, 4.8, 0.0)
    on = np.maximum(t - 0.5, 0.0)
    angle = gain * (4.8 - friction) * (on - tau * (1 - np.exp(-on / tau)))
    step = 2 * np.pi / 1024
    speed = np.diff(np.floor(angle / step), prepend=0.0) * step * 20.0
    found = estimate(Record("motor", t, voltage, velocity=speed))
    q = found.combinations["dc_gain"]
    assert q.value is None or abs(q.value - gain) < 2 * q.total_std
    steady = found.combinations["steady_speed"]
    assert abs(steady.value - gain * (4.8 - friction)) < 4 * steady.std < 1.0


def _step(rows: int, seed: int) -> Record:
    """Return 1.5 s at 8 V, from rest to a steady speed, and ``rows`` rows of coasting."""
    gain, tau, friction = 15.0, 0.12, 2.0
    t = np.arange(60 + rows) / 40.0
    up = gain * (8.0 - friction) * (1 - np.exp(-t / tau))
    down = (up[59] + gain * friction) * np.exp(-(t - t[59]) / tau) - gain * friction
    speed = np.where(t <= t[59], up, np.maximum(down, 0.0))
    noise = 0.5 * np.random.default_rng(seed).standard_normal(t.size)
    return Record("motor", t, np.where(t <= t[59], 8.0, 0.0), velocity=speed + noise)


def test_one_coast_separates_gain_and_friction_in_steps_to_one_level():
    found = estimate([_step(30 if n == 3 else 0, n) for n in range(7)])
    # Friction without a load; four standard deviations are one in 16,000.
    motors.check(found, {"dc_gain": 15.0, "static_voltage": 2.0}, most=0.25)


def test_steps_of_one_size_are_reported_as_hiding_a_driver_ramp():
    """A driver ramp of constant duration is confounded with averaging by the sensor."""
    rng, tau = np.random.default_rng(4), 0.02
    for sizes, said in (((2.0,), True), ((1.0, 2.0, 4.0), False)):
        steps = rng.choice(sizes, 24) * np.r_[np.ones(12), -np.ones(12)]
        command = np.repeat(np.r_[0.0, np.cumsum(steps)], 100)
        speed = apply_lag(8.0 * command, tau / 0.005) + 0.3 * rng.standard_normal(command.size)
        t = 0.005 * np.arange(command.size)
        codes = [f.code for f in estimate(Record("motor", t, command, velocity=speed)).findings]
        assert ("one_size_of_step" in codes) is said and "one_size_of_voltage" not in codes


WINDOW, STEP, UNIT = 32, 1e-3, 0.12982  # samples, s, rounding of the log [rad/s]
TAU, GAIN = 0.025, 17.0


def simulate_logged_step(volts: float) -> Record:
    """Return a step whose speed is a position difference in counts, logged as whole units."""
    rng = np.random.default_rng(3)
    time = STEP * np.arange(1900)
    since = np.maximum(time - 0.4085, 0.0)
    turned = GAIN * volts * (since - TAU * (1 - np.exp(-since / TAU)))
    quantum = 31.25 * UNIT  # no whole number of units: the log shows steps of 31 and 32
    count = np.floor(turned / (quantum * WINDOW * STEP) + rng.uniform())
    difference = count - np.concatenate([np.full(WINDOW, count[0]), count[:-WINDOW]])
    speed = np.round(difference * 31.25) * UNIT + UNIT
    voltage = np.where(time < 0.4085, 0.00226, volts)
    return Record("motor", time, voltage, velocity=speed)


@pytest.mark.parametrize("volts", [8.1, -8.1])
def test_mirrored_step_gives_the_same_estimate(volts):
    record = simulate_logged_step(volts)
    mirror = replace(record, voltage=-record.voltage, velocity=-record.velocity)
    one, other = estimate(record), estimate(mirror)
    assert one.model == other.model
    assert [f.severity for f in one.findings] == [f.severity for f in other.findings]
    for name in ("time_constant", "averaging_window"):
        # The same sums with opposite signs: only rounding may differ.
        assert one.value(name) == pytest.approx(other.value(name), rel=1e-6)
    # A remaining lag takes up to 3 ms from the window; one step is confounded with a driver ramp.
    ramp = one.chain.values.get("ramp_time", 0.0)
    assert one.value("averaging_window") + ramp == pytest.approx(WINDOW * STEP, abs=0.004)
    lag = one.combinations["time_constant"]
    assert abs(lag.value - TAU) < 2 * lag.total_std


@pytest.mark.parametrize("sign", [1, -1])
def test_speed_quantum_is_found_despite_uneven_rounding_of_the_log(sign):
    speed = simulate_logged_step(sign * 8.1).velocity
    # A line through 36 levels, each out by half a unit, is out by far less than a unit.
    assert speed_quantum(speed) == pytest.approx(31.25 * UNIT, rel=0.005)


def test_first_segment_of_one_row_does_not_prevent_an_estimate():
    record = motors.record("rear_left", current=False)
    time = record.time.copy()
    time[1:] += 1.0  # the log lost a second after its first row
    found = estimate(replace(record, time=time, starts=(0, 1)))
    motors.check(found, motors.truth("rear_left", 0.3), ("dc_gain", "static_voltage"))
