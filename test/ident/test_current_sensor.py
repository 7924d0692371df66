"""A current that its sensor averages, low-passes or smooths: shown exactly, apart from the winding.

What a sensor shows of a locked rotor's current is a formula; of a turning motor it is taken of a
simulation in steps 200 times as small.
"""

from __future__ import annotations

from dataclasses import replace

import independent
import motors
import numpy as np
import pytest
from scipy.signal import lfilter
from test_recursion import exact, predict

from smp_motor_ident.estimate import estimate
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.likelihood.noise import NO_GAIN, NoiseModel, kalman_gain
from smp_motor_ident.likelihood.passes import gather
from smp_motor_ident.model.coordinates import LOGARITHMS
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.physical import from_physical
from smp_motor_ident.model.structures import SENSORS, Electromechanical
from smp_motor_ident.record import Hardware, Record

WHEEL = "rear_left"
R, L, K, J, B = independent.TABLE_1[WHEEL]
FINE = 200


def shown(current: np.ndarray, step: float, sensor: str, lag: float, every: int) -> np.ndarray:
    """Return what a sensor shows, every so many of the small steps of a current."""
    if sensor == "smoothed":
        a = step * every / (step * every + lag)
        return lfilter([a], [1, a - 1], current[::every])
    if sensor == "low_passed":
        a = 0.5 * step / lag  # trapezoids
        out = lfilter([a / (1 + a), a / (1 + a)], [1, (a - 1) / (1 + a)], current)
        return out[::every]
    time = step * np.arange(current.size)
    charge = np.concatenate([[0.0], np.cumsum(0.5 * step * (current[1:] + current[:-1]))])
    at = time[::every]
    earlier = np.interp(at - 2 * lag, time, charge, left=0.0)
    return (charge[::every] - earlier) / (2 * lag)


def simulated(
    rate: float, kind: str, seconds: float, sensor: str, lag: float, inductance: float = L
) -> Record:
    """Return a motor's record with the current as a sensor shows it."""
    made = motors.record(WHEEL, kinds=(kind,), seconds=seconds, rate=rate)
    v, step = made.voltage, 1 / rate / FINE
    fine = np.concatenate([v[:1], np.repeat(v[1:], FINE)])
    time = step * np.arange(fine.size)
    load = np.zeros(time.size)
    motion = independent.simulate(time, fine, R, inductance, K, J, B, 0.3 * K / R, load, 2)
    current = shown(motion[:, 0], step, sensor, lag, FINE)
    rng = np.random.default_rng(7)
    count = np.floor(motion[::FINE, 2] / motors.QUANTUM + 0.4).astype(np.int64)
    noisy = current + 0.01 * rng.standard_normal(current.size)
    return replace(made, current=noisy, count=count, velocity=None)


@pytest.mark.parametrize("sensor", SENSORS[1:])
@pytest.mark.parametrize("lag", [0.3 * L / R, L / R, 2.2 * L / R])
def test_a_sensor_shows_the_current_of_a_locked_rotor_as_the_formula_says(sensor, lag):
    time = 5e-3 * np.arange(60)
    record = replace(
        motors.record(WHEEL, kinds=("sine",), seconds=0.3), time=time, voltage=np.full(60, 5.0),
        current=np.zeros(60), count=np.zeros(60, dtype=np.int64), velocity=None,
    )  # fmt: skip
    te, window = L / R, 2 * lag
    if sensor == "averaged":
        charge = lambda t: np.where(t > 0, t - te * -np.expm1(-t / te), 0.0)  # noqa: E731
        expected = (charge(time) - charge(time - window)) / window
    elif sensor == "smoothed":
        a, e = 5e-3 / (5e-3 + lag), np.exp(-time / te)
        expected = lfilter([a], [1, a - 1], 1 - e)
    elif lag == te:
        expected = 1 - (1 + time / te) * np.exp(-time / te)
    else:
        both = te * np.exp(-time / te) - lag * np.exp(-time / lag)
        expected = 1 - both / (te - lag)
    z = from_physical(R, L, K, J, B, 10.0 * K / R)  # friction that 5 V do not break
    z = z.with_(current_lag=lag)
    data = replace(prepare([record], True), initial=np.zeros((1, 5)))
    out = predict(data, Electromechanical(current_sensor=sensor), z)
    # The low-pass is kept 2e-5 apart from the winding's own pole.
    np.testing.assert_allclose(out[:, 2], 5.0 / R * expected, atol=5.0 / R * 2e-5)


@pytest.mark.parametrize("sensor", SENSORS[1:])
@pytest.mark.parametrize("lag", [1.2e-3, 2.5e-3, 7.1e-3])
def test_a_sensor_shows_the_current_of_a_motor_that_turns_and_sticks(sensor, lag):
    recording, data, z = exact(WHEEL, static_voltage=0.5, kind="square", seconds=2.0)
    fine = np.concatenate([recording.voltage[:1], np.repeat(recording.voltage[1:], FINE)])
    step = data.step / FINE
    time = step * np.arange(fine.size)
    motion = independent.simulate(time, fine, R, L, K, J, B, 0.5 * K / R, 0.0 * time, 4)
    out = predict(data, Electromechanical(current_sensor=sensor), z.with_(current_lag=lag))
    # Trapezoids of 25 us on a winding of 20 ms: (h/te)^2/12 = 1.3e-7 of 3.5 A, and four of these.
    expected = shown(motion[:, 0], step, sensor, lag, FINE)
    np.testing.assert_allclose(out[:, 2], expected, atol=3e-6)


@pytest.mark.parametrize("sensor", SENSORS[1:])
@pytest.mark.parametrize("delay", [0.0, 0.0033])
@pytest.mark.parametrize("with_gain", [False, True])
def test_gradient_by_the_lag_is_that_of_finite_differences(sensor, delay, with_gain):
    _, data, z = exact(seconds=2.0, kind="square")
    structure = Electromechanical(delay=delay > 0, offset=True, load=True, current_sensor=sensor)
    matrix = structure.matrix
    z = structure.complete(z).moved(matrix @ np.full(matrix.shape[1], 1e-3))
    z = z.with_(delay=delay, current_lag=3.1e-3)
    gain = NO_GAIN
    if with_gain:
        gain, _ = kalman_gain(structure, z, ANGLE, data.step, 1e7, 0.0)
    begun = np.array([[0.3, 2.0, 0.0, 0.0, 0.2]])

    def run(at):
        return gather(data, structure, at, begun, NoiseModel(np.diag([1e-4, 1e-4]), gain))

    gradient = run(z).gradient[0]
    for j in range(matrix.shape[1]):
        step = 1e-6 if structure.free[j] in LOGARITHMS[:4] else 1e-7
        up, down = (run(z.moved(way * step * matrix[:, j])).cost for way in (1, -1))
        numeric = -0.5 * (up[0] - down[0]) / (2 * step)
        scale = np.abs(gradient).max()
        # As without a sensor in test_recursion.py.
        assert gradient[j] == pytest.approx(numeric, rel=2e-3, abs=1e-6 * scale)


@pytest.mark.parametrize(
    ("sensor", "samples"),
    [
        ("averaged", 0.5),
        ("averaged", 1.5),
        ("low_passed", 0.3),
        ("low_passed", 3.0),
        ("smoothed", 0.7),
        ("smoothed", 3.0),
        ("smoothed", 19.0),
    ],
)
def test_the_lag_of_the_sensor_is_not_taken_for_that_of_the_winding(sensor, samples):
    lag = samples * 5e-3
    result = estimate(simulated(200.0, "fourier", 8.0, sensor, lag))
    assert not result.unreliable
    true = motors.truth(WHEEL, 0.3)
    for name in ("resistance", "inductance", "motor_constant", "inertia"):
        q = result.parameters[name]
        # Four deviations; two thousandths of it are the counter's, which repeats.
        assert abs(q.value - true[name]) < 4 * q.std + 2e-3 * true[name], name
        assert q.std < 0.02 * true[name], name  # and it is known
    found = result.combinations["current_lag"]
    assert found.unit == "s"
    assert abs(found.value - lag) < 4 * found.std + 2e-3 * lag
    said = next(f for f in result.findings if f.code == "current_lag")
    assert said.severity == "note"
    assert said.evidence["sensor"] == sensor


def test_a_current_that_is_read_at_the_instant_has_no_lag_and_is_not_searched_for_one():
    result = estimate(motors.record(WHEEL, seconds=4.0))
    assert "current_lag" not in result.combinations
    tried = [c.model for c in result.candidates]
    assert not [m for m in tried if "averaged current" in m or "low-passed current" in m]


def test_where_winding_and_sensor_look_alike_the_interval_covers_both():
    # L/R of 0.3 ms, read every 5 ms through a low-pass of as much.
    small = 3e-4 * R
    result = estimate(simulated(200.0, "square", 6.0, "low_passed", 3e-4, small))
    q = result.parameters["inductance"]
    assert q.value is None or q.ci95[0] <= small <= q.ci95[1]


@pytest.mark.parametrize("seed", [0, 2, 6])
def test_a_step_of_a_few_rows_leaves_open_whether_winding_or_filter_is_slow(seed):
    # L/R of 0.19 ms behind a digital filter of 2.4 ms: the current steps as behind 4.2 ms of L/R.
    step, fast, rng = 0.005, 1.25e-4, np.random.default_rng(seed)
    v = np.where(np.arange(172) > 8, 3.24, 0.0)
    fine = np.concatenate([v[:1], np.repeat(v[1:], FINE)])
    time = step / FINE * np.arange(fine.size)
    load = np.zeros(time.size)
    motion = independent.simulate(
        time, fine, 0.658, fast, 0.0263, 8.3e-5, 4.1e-4, 0.0174, load, 2
    )  # fmt: skip
    current = shown(motion[:, 0], step / FINE, "smoothed", 2.4e-3, FINE)
    current += 0.01 * rng.standard_normal(current.size)
    count = np.floor(motion[::FINE, 2] * 28 / (2 * np.pi) + rng.uniform()).astype(np.int64)
    coarse = Hardware(1.0, 28.0, 0, None, None)
    q = estimate(Record("motor", time[::FINE], v, current, count=count, hardware=coarse))
    found = q.parameters["inductance"]
    assert found.value is None or abs(found.value - fast) < 4 * found.std
    assert abs(q.parameters["resistance"].value - 0.658) < 4 * q.parameters["resistance"].std


@pytest.mark.parametrize("sensor", ["low_passed", "smoothed"])
def test_a_record_may_begin_while_the_current_flows(sensor):
    lag = 7.5e-3
    whole = simulated(200.0, "square", 8.0, sensor, lag)
    begun = replace(
        whole, time=whole.time[433:] - whole.time[433], voltage=whole.voltage[433:],
        current=whole.current[433:], count=whole.count[433:],
    )  # fmt: skip
    result = estimate(begun)
    q, found = result.parameters["inductance"], result.combinations["current_lag"]
    assert abs(q.value - L) < 4 * q.std + 2e-3 * L  # as above
    assert abs(found.value - lag) < 4 * found.std + 2e-3 * lag


@pytest.mark.parametrize("sensor", SENSORS[1:])
def test_a_sensor_that_would_be_early_shows_the_current_at_once(sensor):
    # Motors are drawn at random around an estimate; a window of less than nothing has no end.
    _, data, z = exact(WHEEL, seconds=1.0)
    early = predict(data, Electromechanical(current_sensor=sensor), z.with_(current_lag=-1e-3))
    direct = predict(data, Electromechanical(), z)
    # A thousandth of a sample late: 5 us of what 12 V change in L.
    np.testing.assert_allclose(early[:, 2], direct[:, 2], atol=5e-6 * 2 * 12 / L)


def test_a_digital_filter_has_taken_the_rows_that_a_log_has_lost():
    _, data, z = exact(WHEEL, kind="square", seconds=2.0)
    structure, z = Electromechanical(current_sensor="smoothed"), z.with_(current_lag=8e-3)
    kept = np.random.default_rng(5).random(data.size) > 0.3
    kept[0] = True
    fewer = replace(
        data, time=data.time[kept], output=data.output[kept], current=data.current[kept],
        starts=np.array([0, kept.sum()]),
    )  # fmt: skip
    whole = predict(data, structure, z)[kept, 2]
    np.testing.assert_allclose(predict(fewer, structure, z)[:, 2], whole, atol=1e-9)


@pytest.mark.parametrize("lag", [1.8e-3, 15e-3])
def test_a_speed_of_differences_does_not_hide_the_filter_of_the_current(lag):
    el = 2.8e-3 * R  # settled half-way within a sample
    made = simulated(200.0, "square", 8.0, "smoothed", lag, el)
    counts = made.count
    assert counts is not None
    result = estimate(
        replace(made, count=None, velocity=200 * motors.QUANTUM * np.diff(counts, prepend=0))
    )
    assert not result.unreliable
    true = motors.truth(WHEEL, 0.3) | {"inductance": el}
    for name in ("resistance", "inductance", "motor_constant", "inertia"):
        q = result.parameters[name]
        if q.value is not None:
            assert abs(q.value - true[name]) < 4 * q.std + 2e-3 * true[name], name  # as above


def test_a_current_is_not_given_up_for_a_speed_that_is_a_mean():
    """A quick motor's speed over a sample is off by far more than its encoder, its current not."""
    r, el, k, j, b = 0.41, 8e-4, 0.0184, 2.26e-5, 9.1e-5
    rng = np.random.default_rng(8)
    volts = 2.6 * np.repeat(rng.choice([-1.0, 1.0], 600), 6)
    t = np.arange(volts.size) / 200
    out = independent.simulate(t, volts, r, el, k, j, b, 4.7e-3, np.zeros(t.size), 200)
    count = np.floor(out[:, 2] * 4096 / (2 * np.pi))
    speed = np.diff(count, prepend=0.0) * 2 * np.pi / 4096 * 200
    amps = out[:, 0] + 0.02 * rng.standard_normal(t.size)
    found = estimate(Record("motor", t, volts, amps, speed))
    for name, true in (("resistance", r), ("inductance", el), ("dc_gain", k / (k * k + r * b))):
        q = (found.parameters | found.combinations)[name]
        assert abs(q.value - true) < max(5 * q.std, 5e-3 * true), name
    assert not found.unreliable


@pytest.mark.parametrize("r, j, step, seed", [(1.0, 0.032, 0.01, 3), (4.6, 0.011, 0.02, 1)])
def test_a_mean_speed_and_a_mean_current_do_not_hide_each_other(r, j, step, seed):
    """A slow logger's means of both: neither alone explains the rows better than a greater L.

    Where the winding settles at once, the descents begin too far from the window of a row.
    """
    el, k, b, fine = 5.5e-4, 0.51, 9e-3, 100
    rng = np.random.default_rng(seed)
    volts = np.repeat(rng.uniform(-9.0, 9.0, 24), 50)
    every = np.concatenate([volts[:1], np.repeat(volts[1:], fine)])
    time = step / fine * np.arange(every.size)
    out = independent.simulate(time, every, r, el, k, j, b, 0.33, np.zeros(time.size), 2)
    count = np.floor(out[::fine, 2] * 1496 / (2 * np.pi) + 0.3)
    speed = np.diff(count, prepend=count[0]) * 2 * np.pi / 1496 / step
    amps = shown(out[:, 0], step / fine, "averaged", 0.5 * step, fine)
    amps += 0.006 * rng.standard_normal(amps.size)
    found = estimate(Record("motor", step * np.arange(volts.size), volts, amps, speed))
    assert not found.unreliable
    true = {"resistance": r, "inductance": el, "motor_constant": k, "inertia": j}
    for name, value in true.items():
        q = found.parameters[name]
        if q.value is not None:
            assert abs(q.value - value) < 4 * q.std + 2e-3 * value, name  # as above
    lag = found.combinations["current_lag"]
    assert abs(lag.value - 0.5 * step) < 4 * lag.std + 1e-3 * step


@pytest.mark.parametrize("sensor", ["low_passed", "averaged"])
def test_a_command_that_is_late_does_not_hide_how_the_current_is_filtered(sensor):
    """Without the delay a mean had seemed likelier than a low-pass, and L seven times as large."""
    r, el, k, j, b, step, fine, lag = 2.65, 1.44e-3, 1.457, 0.1235, 0.02, 2e-3, 50, 4e-3
    up = np.arange(1, 6) * 1.8
    levels = np.concatenate([up, up[-2::-1], [0.0], -up, -up[-2::-1], [0.0]])
    volts = np.repeat(levels, 250)
    every = np.concatenate([volts[:1], np.repeat(volts[1:], fine)])
    time = step / fine * np.arange(every.size)
    out = independent.simulate(time, every, r, el, k, j, b, 0.326, np.zeros(time.size), 2)
    rng = np.random.default_rng(21)
    amps = shown(out[:, 0], step / fine, sensor, lag, fine)
    amps += 3e-3 * rng.standard_normal(amps.size)
    speed = out[::fine, 1] + 3e-3 * rng.standard_normal(amps.size)
    early = np.append(volts[1:], volts[-1])  # each row's command is in force after it
    found = estimate(Record("motor", step * np.arange(volts.size), early, amps, speed))
    assert not found.unreliable
    true = {"resistance": r, "inductance": el, "motor_constant": k, "inertia": j}
    for name, value in true.items():
        q = found.parameters[name]
        assert abs(q.value - value) < 4 * q.std + 2e-3 * value, name  # as above
    assert found.parameters["inductance"].std < 0.2 * el
    said = next(f for f in found.findings if f.code == "current_lag")
    assert said.evidence["sensor"] == sensor


@pytest.mark.parametrize(
    ("motor", "step", "sensor", "slow", "lag"),
    [
        ((9.0, 3.5e-4, 0.017, 2.1e-7, 1e-8, 2e-4), 2.5e-3, "low_passed", 14.5e-3, 7.3e-3),
        ((2.65, 1.44e-3, 1.457, 0.1235, 0.02, 0.326), 0.02, "smoothed", 25.6e-3, 47.2e-3),
    ],
)
def test_a_filter_of_the_speed_and_one_of_the_current_do_not_hide_each_other(
    motor, step, sensor, slow, lag
):
    """Neither alone explains a smooth command better: time constants had been 3.4 times as long."""
    r, el, k, j, b, friction = motor
    tau, fine, n = r * j / (k * k + r * b), 50, 1500
    rng = np.random.default_rng(5)
    tones = np.array([0.3, 0.7, 1.3, 2.5, 4.9]) / tau
    volts = 2.5 * np.sin(np.outer(step * np.arange(n), tones) + rng.uniform(0, 6.28, 5)).sum(axis=1)
    every = np.concatenate([volts[:1], np.repeat(volts[1:], fine)])
    time = step / fine * np.arange(every.size)
    out = independent.simulate(time, every, r, el, k, j, b, friction, np.zeros(time.size), 2)
    amps, speed = (shown(out[:, m], step / fine, sensor, x, fine) for m, x in ((0, lag), (1, slow)))
    amps = amps + 2e-3 * np.ptp(amps) * rng.standard_normal(n)
    speed = speed + 2e-3 * np.ptp(speed) * rng.standard_normal(n)
    found = estimate(Record("motor", step * np.arange(n), volts, amps, speed))
    assert not found.unreliable
    known = found.parameters | found.combinations
    true = {"resistance": r, "motor_constant": k, "inertia": j, "time_constant": tau}
    for name, value in true.items():
        assert abs(known[name].value - value) < 4 * known[name].std + 2e-3 * value, name  # as above
    assert abs(known["current_lag"].value - lag) < 0.05 * lag
    assert abs(known["sensor_lag"].value - slow) < 0.05 * slow
