# SPDX-License-Identifier: Apache-2.0
"""The speed observer, fed with encoder counts, compared with the exact motor."""

import math

import numpy as np
import pytest
from paper_motors import combinations_of, paper_motor
from scipy.linalg import expm

from smp_motor_control.encoder import DifferencedSpeed, Encoder
from smp_motor_control.errors import ParameterError
from smp_motor_control.motor import Motor, MotorParameters
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.observer import ObserverNoise, SpeedObserver, prediction, steady_gain

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
