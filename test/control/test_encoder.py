# SPDX-License-Identifier: Apache-2.0
"""Counts from angles, rollover of counters, and speed from counts: differenced or observed."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper_motors import combinations_of, paper_motor
from scipy.linalg import expm

from smp_motor_control.encoder import DifferencedSpeed, Encoder, Unwrapper, unwrap, wrap
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor import Motor, MotorParameters
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.observer import ObserverNoise, SpeedObserver, prediction, steady_gain


@given(
    bits=st.integers(2, 62),
    steps=st.lists(st.floats(-0.49, 0.49), min_size=1, max_size=50),
    start=st.integers(-(2**40), 2**40),
)
def test_unwrapping_inverts_wrapping_for_steps_below_half_the_range(bits, steps, start):
    moved = np.array([int(s * 2**bits) for s in steps], dtype=object)
    total = [start, *(start + np.cumsum(moved))]
    shown = [wrap(int(c), bits) for c in total]
    if max(abs(c) for c in total) < 2**62:
        recovered = unwrap(np.array(shown, dtype=np.int64), bits)
        assert [int(c) - shown[0] for c in recovered] == [int(c) - start for c in total]
    one_by_one = Unwrapper(bits)
    assert [one_by_one(c) - shown[0] for c in shown] == [int(c) - start for c in total]


@pytest.mark.parametrize("bits", [8, 16, 32])
def test_unsigned_counters_unwrap_like_signed_ones(bits):
    total = np.cumsum(np.random.default_rng(1).integers(-100, 100, 1000))
    unsigned = total % (1 << bits)
    assert np.array_equal(np.diff(unwrap(unsigned, bits)), np.diff(total))


def test_count_is_the_angle_rounded_down_to_whole_counts():
    encoder = Encoder(500.0)
    one = encoder.angle_per_count
    assert [encoder.count(k * one * 1.0001) for k in (0, 1, 250, 500)] == [0, 1, 250, 500]
    assert encoder.count(-0.5 * one) == -1


def test_window_of_zero_samples_is_refused():
    with pytest.raises(ParameterError, match="window"):
        DifferencedSpeed(Encoder(), 0)


@pytest.mark.parametrize("bits", [2, 8, 16, 63])
def test_counter_wraps_in_twos_complement_at_range_ends(bits):
    half = 2 ** (bits - 1)
    shows = {half - 1: half - 1, half: -half, -half: -half, -half - 1: half - 1, 2 * half: 0}
    for count, expected in shows.items():
        assert wrap(count, bits) == expected
        assert wrap(count, 0) == count
        # One step from zero, along the shorter direction.
        for unwrapped in (Unwrapper(bits), Unwrapper(0)):
            assert unwrapped(0) == 0
        one = Unwrapper(bits)
        one(0)
        assert one(count if bits < 63 else expected) == expected
        assert Encoder(500.0, bits).bits == bits


@pytest.mark.parametrize("bits", [-1, 1, 64, 2.5])
def test_invalid_counter_width_is_refused(bits):
    for make in (lambda: Encoder(bits=bits), lambda: Unwrapper(bits), lambda: unwrap([0, 1], bits)):
        with pytest.raises(ParameterError, match="encoder_bits"):
            make()


def test_unwrap_copies_counts_without_wraps_and_empty_arrays():
    counts = np.array([0, 200, -300, 2**40])
    for bits, shown in ((0, counts), (8, counts[:0])):
        result = unwrap(shown, bits)
        assert np.array_equal(result, shown) and result is not shown
    result = unwrap(counts, 0)
    result[0] = 7
    assert counts[0] == 0
    assert unwrap([1], 8).tolist() == [1]


def test_unwrapper_starts_from_next_count_after_reset():
    one = Unwrapper(8)
    assert [one(c) for c in (100, 127, -128)] == [100, 127, 128]
    one.reset()
    assert [one(c) for c in (-100, -90)] == [-100, -90]


@pytest.mark.parametrize("window", [1, 2, 5])
def test_speed_is_the_count_difference_over_its_window(window):
    speed, counts = DifferencedSpeed(Encoder(64.0), window), [0, 3, 4, 4, 9, 2, 30, 31]
    assert speed.total == 0
    times = np.cumsum([0.5, 0.25, 0.125, 0.5, 1.0, 0.25, 0.125, 2.0])
    for k, (time, count) in enumerate(zip(times, counts)):
        value, first = speed.step(float(time), count), max(k - window, 0)
        assert speed.total == count
        if k == 0:
            assert math.isnan(value)
        else:
            moved = (count - counts[first]) * 2.0 * math.pi / 64.0
            assert value == pytest.approx(moved / (times[k] - times[first]))
    assert math.isnan(DifferencedSpeed(Encoder()).step(1.0, 5))
    again = DifferencedSpeed(Encoder(64.0), 1)
    again.step(1.0, 5)
    assert math.isnan(again.step(1.0, 9)), "no time has passed"
    plain = DifferencedSpeed(Encoder(64.0))  # a window of one
    for k in range(3):
        value = plain.step(float(k), k * k)
    assert value == pytest.approx(3.0 * 2.0 * math.pi / 64.0)


def test_reset_clears_counter_and_window():
    speed = DifferencedSpeed(Encoder(64.0, 8), window=2)
    speed.step(0.0, 100)
    speed.step(1.0, 120)
    speed.reset()
    assert math.isnan(speed.step(2.0, -100)) and speed.total == -100


def test_counts_per_revolution_has_default_and_accepts_its_limits():
    assert Encoder().counts_per_revolution == 500.0 and Encoder().bits == 0
    for value in (1e-3, 1e9):
        assert Encoder(value).angle_per_count == pytest.approx(2.0 * math.pi / value)


# Motors 1 (complex poles) and 2 (real poles) of the paper, and one without inductance.
MOTORS = {
    "motor 1": paper_motor("front_left", 0.445),
    "motor 2": paper_motor("front_right", 0.388),
    "first order": MotorParameters(
        resistance=3.0, inductance=0.0, motor_constant=0.03, inertia=1.4e-5, viscous_friction=5e-5,
        coulomb_friction=0.0,
    ),
}  # fmt: skip
ENCODER = Encoder(500.0)


def model_of(p: MotorParameters, **changes: float) -> MotorModel:
    return MotorModel(**combinations_of(p) | changes)


def volts(t: float) -> float:
    # Incommensurate with every sampling here, so that quantisation does not repeat.
    return 6.0 + 2.0 * math.sin(8.3 * t) + 1.0 * math.sin(2.0 * math.pi * 0.31 * t)


def make_motor_and_observer(p: MotorParameters, **changes: float) -> tuple[Motor, SpeedObserver]:
    return Motor(p), SpeedObserver(model_of(p), 0.005, ENCODER, **changes)


def simulate_errors(p, observer, dt, duration=2.0, load=0.0, jitter=0.0):
    """Return errors of the observer and of differenced counts after the first 0.5 s [rad/s]."""
    rng = np.random.default_rng(3)
    motor, differenced = Motor(p), DifferencedSpeed(ENCODER)
    time, seen, counted = 0.0, [], []
    torque = load * p.motor_constant / p.resistance
    while time < duration:
        step = dt * (1.0 + jitter * rng.uniform(-1.0, 1.0))
        voltage = volts(time)
        motor.step(voltage, step, torque)
        time += step
        count = ENCODER.count(motor.angle)
        speed, difference = observer.step(count, voltage, step), differenced.step(time, count)
        if time > 0.5:
            seen.append(speed - motor.speed)
            counted.append(difference - motor.speed)
    return np.array(seen), np.array(counted)


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


@pytest.mark.parametrize("name", MOTORS)
@pytest.mark.parametrize("rate", [200.0, 1000.0])
def test_observer_halves_error_of_differenced_counts(name, rate):
    p = MOTORS[name]
    # Every model parameter is off by 1 %, as after a mediocre identification.
    wrong = {n: 1.01 * getattr(p, n) for n in ("dc_gain", "time_constant")}
    observer = SpeedObserver(model_of(p, **wrong), 1.0 / rate, ENCODER)
    seen, counted = simulate_errors(p, observer, 1.0 / rate)
    assert rms(seen) <= 0.5 * rms(counted)  # the claimed improvement


@pytest.mark.parametrize("name", MOTORS)
def test_unknown_load_is_estimated_without_speed_bias(name):
    p = MOTORS[name]
    observer = SpeedObserver(model_of(p), 0.005, ENCODER)
    seen, _ = simulate_errors(p, observer, 0.005, duration=4.0, load=1.5)
    # 700 samples of an error correlated over some 20 ms: the mean is known to 1/sqrt(175) of the
    # rms of 0.4. Without a load estimate the bias would be 25 rad/s.
    assert np.mean(seen) == pytest.approx(0.0, abs=0.1)
    assert observer.load == pytest.approx(1.5, abs=0.3)  # its own steady deviation is 0.1 V
    assert observer.trusted


def test_observer_tolerates_20_percent_sampling_jitter():
    p = MOTORS["motor 1"]
    observer = SpeedObserver(model_of(p), 0.005, ENCODER)
    seen, _ = simulate_errors(p, observer, 0.005, jitter=0.2)
    steady, _ = simulate_errors(p, SpeedObserver(model_of(p), 0.005, ENCODER), 0.005)
    # The voltage is known exactly over every interval; gains are those of the nearest one.
    assert rms(seen) <= 1.2 * rms(steady)


@pytest.mark.parametrize("late", [0.02, 0.05, 0.2])  # of a sample, either way
def test_observer_stays_trusted_under_stamp_jitter_of_many_counts(late):
    """Counts are sampled periodically and stamped on arrival."""
    p, dt = MOTORS["motor 1"], 0.005
    fine, rng, motor = Encoder(2_000.0), np.random.default_rng(6), Motor(p)
    observer = SpeedObserver(model_of(p), dt, fine)
    before, errors = 0.0, []
    for k in range(1, 1_000):
        voltage = volts(k * dt)
        motor.step(voltage, dt, 0.0)
        stamp = dt * (k + late * rng.uniform(-1.0, 1.0))
        speed = observer.step(fine.count(motor.angle), voltage, stamp - before)
        before = stamp
        if k > 200:
            assert observer.trusted
            errors.append(speed - motor.speed)
    usual = 6.0 * model_of(p).dc_gain
    assert late * dt * usual > 4.0 * fine.angle_per_count
    # Differenced counts would have this stamp jitter twice, independently.
    assert rms(np.array(errors)) < 0.5 * late * math.sqrt(2.0 / 3.0) * usual


def test_lost_samples_are_bridged_by_the_model():
    motor, observer = make_motor_and_observer(MOTORS["motor 1"])
    errors = []
    for k in range(600):
        lost = 3 if k % 20 == 0 else 1
        motor.step(6.0, lost * 0.005)
        speed = observer.step(ENCODER.count(motor.angle), 6.0, lost * 0.005)
        errors.append(speed - motor.speed)
    assert rms(np.array(errors[200:])) < 0.5
    assert observer.trusted


def test_counter_wrap_does_not_change_estimate():
    p = MOTORS["motor 1"]
    narrow, wide = Encoder(500.0, bits=12), Encoder(500.0)
    motor = Motor(p)
    observers = [SpeedObserver(model_of(p), 0.005, e) for e in (narrow, wide)]
    for _ in range(800):
        motor.step(8.0, 0.005)
        speeds = [
            observer.step(encoder.count(motor.angle), 8.0, 0.005)
            for observer, encoder in zip(observers, (narrow, wide), strict=True)
        ]
        assert speeds[0] == pytest.approx(speeds[1], nan_ok=True)


def test_known_delay_is_compensated():
    p, dt, delay = MOTORS["motor 2"], 0.005, 0.0075
    motor = Motor(p)
    aware = SpeedObserver(model_of(p, delay=delay), dt, ENCODER)
    unaware = SpeedObserver(model_of(p), dt, ENCODER)
    held, errors = [0.0] * 4, {aware: [], unaware: []}
    for k in range(600):
        voltage = 6.0 if k % 40 < 20 else 3.0
        held.append(voltage)
        # 1.5 samples late: half an interval of each of two earlier voltages.
        motor.step(held[-3], dt / 2.0)
        motor.step(held[-2], dt / 2.0)
        for observer, found in errors.items():
            found.append(observer.step(ENCODER.count(motor.angle), voltage, dt) - motor.speed)
    late, right = rms(np.array(errors[unaware][200:])), rms(np.array(errors[aware][200:]))
    assert right < 0.6
    assert late > 2.0 * right


@pytest.mark.parametrize("factor", [3.0, 0.3])
def test_observer_falls_back_to_differenced_counts_with_wrong_model(factor):
    p = MOTORS["motor 1"]
    wrong = model_of(p, dc_gain=factor * p.dc_gain, time_constant=p.time_constant / factor)
    observer = SpeedObserver(wrong, 0.005, ENCODER, window=1)
    motor, differenced, fell_back = Motor(p), DifferencedSpeed(ENCODER), 0
    for k in range(800):
        voltage = 8.0 if k % 100 < 50 else 2.0
        motor.step(voltage, 0.005)
        count = ENCODER.count(motor.angle)
        speed = observer.step(count, voltage, 0.005)
        counted = differenced.step(0.005 * k, count)
        if not observer.trusted:
            fell_back += 1
            assert speed == pytest.approx(counted)
    assert fell_back > 40


def test_observer_trust_returns_when_model_and_counts_agree():
    motor, observer = make_motor_and_observer(MOTORS["motor 1"])
    trusted = []
    for k in range(1200):
        # For a second the motor gets another voltage than the reported one.
        reported = 6.0
        motor.step(reported if not 400 <= k < 600 else (-6.0 if k % 40 < 20 else 6.0), 0.005)
        observer.step(ENCODER.count(motor.angle), reported, 0.005)
        trusted.append(observer.trusted)
    assert all(trusted[100:400])
    assert not all(trusted[400:600])
    assert all(trusted[-200:])
    assert observer.speed == pytest.approx(motor.speed, abs=1.5)  # four deviations of 0.35


def test_observer_is_not_trusted_when_load_exceeds_its_limit():
    motor, observer = make_motor_and_observer(MOTORS["motor 1"], max_load=18.0)
    trusted = True
    for k in range(1000):
        # The encoder counts backwards: the model needs twice the voltage as a load.
        motor.step(11.0, 0.005)
        observer.step(-ENCODER.count(motor.angle), 11.0, 0.005)
        trusted = trusted and (observer.trusted or k < 200)
    assert not trusted
    assert observer.speed < 0.0


def test_estimate_is_zero_at_standstill_under_voltage_below_friction():
    motor, observer = make_motor_and_observer(MOTORS["motor 1"])
    for _ in range(400):
        motor.step(0.3, 0.005)  # below the 0.45 V of dry friction
        observer.step(ENCODER.count(motor.angle), 0.3, 0.005)
    assert motor.speed == 0.0
    assert observer.speed == pytest.approx(0.0, abs=1e-6)
    assert observer.trusted


@pytest.mark.parametrize("bad", [(math.nan, 0.005), (1.0, 0.0), (1.0, -0.1), (1.0, math.nan)])
def test_invalid_sample_is_refused_and_leaves_state_unchanged(bad):
    p = MOTORS["motor 1"]
    disturbed, calm = (SpeedObserver(model_of(p), 0.005, ENCODER) for _ in range(2))
    for observer in (disturbed, calm):
        for k in range(20):
            observer.step(3 * k, 6.0, 0.005)
    with pytest.raises(ParameterError, match="observer"):
        disturbed.step(60, *bad)
    assert disturbed.step(61, 6.0, 0.005) == calm.step(61, 6.0, 0.005)


def test_observer_restarts_from_counts_after_long_gap():
    motor, observer = make_motor_and_observer(MOTORS["motor 1"])
    for step in [0.005] * 200 + [3.0] + [0.005] * 200:
        motor.step(6.0, step)
        observer.step(ENCODER.count(motor.angle), 6.0, step)
    assert observer.speed == pytest.approx(motor.speed, abs=1.5)


@pytest.mark.parametrize("electrical", [2e-4, 1e-3, 1e-2])
def test_steady_gain_matches_kalman_recursion_in_fine_steps(electrical):
    # The covariance is propagated in steps of L/R / 50, for which Van Loan's matrix exponential is
    # well conditioned, and corrected every 20 ms until it is stationary.
    dt, tau, gain, quantum, noise = 0.02, 0.1, 20.0, 2.0 * math.pi / 500.0, ObserverNoise()
    tp = tau * electrical
    drift = np.zeros((4, 4))
    drift[0, 1] = drift[1, 2] = 1.0
    drift[2] = [0.0, -1.0 / tp, -tau / tp, -gain / tp]
    sources = np.diag([0.0, 0.0, noise.voltage * gain / tp, noise.load]) ** 2
    pieces = math.ceil(50.0 * dt / electrical)
    block = np.block([[-drift, sources], [np.zeros((4, 4)), drift.T]]) * dt / pieces
    piece = expm(block)
    short = piece[4:, 4:].T
    F, Q = np.eye(4), np.zeros((4, 4))
    for _ in range(pieces):
        Q = short @ Q @ short.T + short @ piece[:4, 4:]
        F = short @ F
    P, R = np.diag([1.0, 1e2, 1e6, 1.0]), (noise.count * quantum) ** 2
    for _ in range(400):
        K = P[:, 0] / (P[0, 0] + R)
        P = F @ (P - np.outer(K, P[0])) @ F.T + Q
    K = P[:, 0] / (P[0, 0] + R)
    model = MotorModel(dc_gain=gain, time_constant=tau, time_constant_product=tp)
    # Rounding of 5,000 products whose squared entries span ten decades
    assert steady_gain(model, quantum, noise, dt)[:4] == pytest.approx(K, rel=1e-6)


def test_steady_gain_stabilises_observer_of_random_motors_and_rates():
    rng = np.random.default_rng(5)
    for _ in range(100):
        electrical, tau = 10.0 ** rng.uniform(-9, -2), 10.0 ** rng.uniform(-3, 1)
        model = MotorModel(
            dc_gain=10.0 ** rng.uniform(-1, 3),
            time_constant=tau + electrical,
            time_constant_product=tau * electrical,
        )
        dt = 10.0 ** rng.uniform(-4, 0)
        gain = steady_gain(model, 2.0 * math.pi / 500.0, ObserverNoise(), dt)
        (F,), _ = prediction(model, np.array([dt]))
        # In time constants, so that the eigenvalues are not those of a badly scaled matrix.
        scale = np.array([1.0, 1.0 / tau, 1.0 / (tau * electrical), 1.0 / (tau * model.dc_gain)])
        error = (F - np.outer(F @ np.array(gain[:4]), [1.0, 0.0, 0.0, 0.0])) * scale
        assert np.abs(np.linalg.eigvals(error / scale[:, None])).max() < 1.0
