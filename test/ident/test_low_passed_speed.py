"""A speed that firmware low-passes: the compiled filter, and motors found behind one."""

from dataclasses import replace

import independent
import motors
import numpy as np
import passes
import pytest
from scipy.signal import lfilter

from smp_motor_ident.diagnosis.sensors import sensors
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.simulation import simulate
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.physical import from_physical
from smp_motor_ident.model.structures import Electromechanical, SecondOrder
from smp_motor_ident.record import Record
from smp_motor_ident.tune import motors as tuned

STEP = 5e-3
FINE = 50  # parts of a sample in which the tests' own motor and filter run


def filtered(
    lag, static_voltage, seconds=10.0, noise=0.0, kind="fourier", wheel="rear_left", ticks=0,
    means=False,
):  # fmt: skip
    """Return a record of a motor of Table 1 whose speed went through a low-pass, or a digital one.

    That takes so many samples of the speed a row, or means since the one before.
    """
    n = int(seconds / STEP)
    t = np.arange(n * FINE) * STEP / FINE
    voltage = independent.excitation(np.arange(n) * STEP, kind, 10.0)
    # A row's voltage ran before it: sample k is the end of the k-th interval.
    held = np.concatenate([[voltage[0]], np.repeat(voltage[1:], FINE)])
    t = np.arange(held.size) * STEP / FINE
    r, el, k, j, b = independent.TABLE_1[wheel]
    out = independent.simulate(
        t, held, r, el, k, j, b, static_voltage * k / r, np.zeros(t.size), 4
    )  # fmt: skip
    gone = np.exp(-STEP / FINE / lag)
    mean = 0.5 * (out[1:, 1] + out[:-1, 1])
    speed = np.concatenate([[0.0], lfilter([1 - gone], [1, -gone], mean)])[::FINE]
    if ticks:
        a = STEP / (STEP + ticks * lag)
        taken, angle = out[:: FINE // ticks, 1], out[:: FINE // ticks, 2]
        if means:  # as a firmware has that counts
            taken = np.diff(angle, prepend=angle[0]) * ticks / STEP
        speed = lfilter([a], [1, a - 1], taken)[::ticks]
    rng = np.random.default_rng(2)
    speed = speed + noise * rng.standard_normal(n)
    amps = out[::FINE, 0] + 0.01 * rng.standard_normal(n)
    return Record("motor", np.arange(n) * STEP, voltage, amps, speed, source="bag")


SAMPLED = pytest.mark.parametrize(
    ("ticks", "means"), [(0, False), (1, False), (5, False), (1, True), (5, True)]
)


@SAMPLED
@pytest.mark.parametrize("lag", [0.1 * STEP, STEP, 30 * STEP])
def test_prediction_is_that_of_a_filter_in_small_steps(lag, ticks, means):
    mean = STEP / ticks if means else 0.0
    passes.assert_predicts(
        filtered(lag, 0.3, ticks=ticks, means=means),
        Electromechanical(window=True, low_pass=True, ticks=ticks, mean=mean),
        lag + 0.5 * mean,
    )


@SAMPLED
@pytest.mark.parametrize("lag", [0.1 * STEP, STEP, 30 * STEP])
def test_gradient_is_that_of_finite_differences(lag, ticks, means):
    record = filtered(STEP, 0.0, 3.0, noise=1.0)
    mean = STEP / ticks if means else 0.0
    structure = SecondOrder(friction="none", window=True, low_pass=True, ticks=ticks, mean=mean)
    data = prepare([record], False).measured_as(structure.speed)
    z = structure.complete(from_physical(*independent.TABLE_1["rear_left"]))
    z = z.with_(window=2 * lag + mean)
    passes.assert_gradient(data, structure, z)


@pytest.mark.parametrize(
    ("lag", "ticks", "means"),
    [
        (0.4 * STEP, 0, False), (3 * STEP, 0, False), (3 * STEP, 1, False), (STEP, 5, False),
        (1.5 * STEP, 1, True), (3 * STEP, 2, True),
    ],
)  # fmt: skip
def test_a_motor_with_current_is_found_behind_its_speed_s_low_pass(lag, ticks, means):
    """Means that a firmware counts come half of their time late: of L/R if nobody knows."""
    record = filtered(lag, 0.3, 20.0, noise=0.1, ticks=ticks, means=means)
    found = estimate(record)
    assert "low_passed_speed" in [f.code for f in found.findings]
    late = lag + 0.5 * STEP / ticks if means else lag
    truth = motors.truth("rear_left", 0.3) | {"sensor_lag": late}
    for name in ("sensor_lag", "dc_gain", "time_constant", "resistance", "inductance"):
        q = (found.parameters | found.combinations)[name]
        assert abs(q.value - truth[name]) < max(4 * q.std, 5e-3 * truth[name]), name
        assert q.std < 3e-3 * truth[name]
    # What gains are computed for is that motor behind that filter.
    motor = tuned.motors_of(found)
    behind = motor.sensor_lag[0] + 0.5 * motor.averaging_window[0]
    assert behind == pytest.approx(late, rel=0.05)
    # What it would have done is seen through the filter that was found: but for noise the same.
    measured, simulated = simulate(found, record)
    assert np.std(measured - simulated) < 1.03 * 0.1


def test_a_filter_of_no_time_is_not_spoken_of():
    structure = SecondOrder(friction="none", window=True, low_pass=True, ticks=1)
    data = prepare([filtered(STEP, 0.0, 3.0, noise=1.0)], False).measured_as(structure.speed)
    fit = initial_fit(data, structure, Options())
    for window, codes in ((2 * STEP, ["low_passed_speed"]), (1e-9, [])):
        there = replace(fit, z=fit.z.with_(window=window))
        assert [f.code for f in sensors(data, there)] == codes


@pytest.mark.parametrize("current", [False, True])
def test_a_motor_is_found_behind_a_filter_that_is_slower_than_it(current):
    """Which lag is whose shows where the motor rubs; where the filter begins is its own."""
    lag = 30 * STEP
    record = filtered(lag, 0.5, noise=0.1)
    record = record.slice(137, len(record))
    found = estimate(record if current else replace(record, current=None))
    truth = motors.truth("rear_left", 0.5) | {"sensor_lag": lag}
    assert lag > 2 * truth["time_constant"]
    for name in ("sensor_lag", "dc_gain", "time_constant", "static_voltage"):
        q = found.combinations[name]
        assert abs(q.value - truth[name]) < max(4 * q.std, 5e-3 * truth[name]), name
        assert q.std < 0.1 * truth[name]


def test_a_filter_that_is_slower_than_the_motor_does_not_hide_its_friction():
    """Of a sine it leaves next to none of what friction makes, and a linear motor asks for none."""
    lag = 60 * STEP
    found = estimate(replace(filtered(lag, 0.3, noise=0.1, kind="sine"), current=None))
    truth = motors.truth("rear_left", 0.3) | {"sensor_lag": lag}
    for name in ("sensor_lag", "dc_gain", "time_constant", "static_voltage"):
        q = found.combinations[name]
        assert abs(q.value - truth[name]) < 4 * q.std < 0.15 * truth[name], name


def test_a_low_pass_that_is_known_is_taken_as_given():
    lag = 2 * STEP
    record = replace(filtered(lag, 0.3, noise=0.1), current=None)
    found = estimate(record, fixed={"sensor_lag": lag})
    truth = motors.truth("rear_left", 0.3)
    q = found.combinations["time_constant_product"]
    assert abs(q.value - truth["time_constant_product"]) < 4 * q.std
    assert found.value("sensor_lag") == pytest.approx(lag)
    assert found.combinations["sensor_lag"].status == "fixed"


@pytest.mark.parametrize("static_voltage", [0.0, 0.6])
def test_a_second_lag_of_a_speed_that_is_driven_one_way_may_be_its_filters(static_voltage):
    """What no reversal shows: the motor's own time constant is the first alone."""
    rng = np.random.default_rng(4)
    voltage = np.repeat(rng.uniform(4.0, 10.0, 40), 40)
    r, el, k, j = 2.0, 1e-3, 0.05, 5e-5
    motor = j * r / k**2
    held = np.repeat(voltage, FINE)
    t = np.arange(held.size) * STEP / FINE
    torque = static_voltage * k / r
    out = independent.simulate(t, held, r, el, k, j, 0.0, torque, np.zeros(t.size), 1)
    gone = np.exp(-STEP / FINE / (0.2 * motor))
    speed = lfilter([1 - gone], [1, -gone], out[:, 1])[FINE - 1 :: FINE]
    speed = speed + 1e-3 * np.ptp(speed) * rng.standard_normal(speed.size)
    record = Record("motor", STEP * np.arange(speed.size), voltage, velocity=speed)
    found = estimate(record).combinations["time_constant"]
    # As a winding's the second lag makes the motor slower by a fifth.
    assert found.value == pytest.approx(1.2 * motor, rel=0.05)
    assert 1.0 < (found.value - motor) / found.std < 3.0


@pytest.mark.parametrize("lags", [(0.037, 0.008, 0.008), (0.03, 0.005, 0.06)])
def test_whose_of_a_speed_s_lags_is_whose_is_open_where_the_motor_never_turns_back(lags):
    """Lags in a row answer alike in any order: each may be the filter's, the others the motor's."""
    rate, fine, rng = 1000, 20, np.random.default_rng(1)
    volts = np.repeat([1.6, 6.4, 3.0, 5.0, 2.0], 1000)
    speed = 26.0 * np.repeat(volts - 0.3, fine)
    for lag in lags:
        gone = np.exp(-1 / rate / fine / lag)
        speed = lfilter([1 - gone], [1, -gone], speed, zi=[gone * speed[0]])[0]
    shown = np.r_[speed[0], speed[fine - 1 :: fine][:-1]] + 0.1 * rng.standard_normal(volts.size)
    held = np.r_[volts[0], volts[:-1]]
    found = estimate(Record("motor", np.arange(volts.size) / rate, held, velocity=shown))
    assert not found.unreliable
    q, sensor = (found.combinations[n] for n in ("time_constant", "sensor_lag"))
    for own in lags:
        assert abs(sensor.value - own) < 2.5 * sensor.std
        assert abs(q.value - (sum(lags) - own)) < 2.5 * q.std
    # Few filters are slower than their motor: of all of them that is the least likely.
    assert sensor.value < q.value
    said = next(f for f in found.findings if f.code == "low_passed_speed")
    assert "do not tell" in said.message and said.advice


def test_a_load_does_not_hide_which_of_two_lags_is_the_filters():
    """Friction that is greater one way looks like a load; without that a winding fits better."""
    rng = np.random.default_rng(4)
    rate, gain, lag, smooth = 5000.0, 25.0, 0.36, 0.17
    levels = (0.0, 9.0, 0.0, -9.5, 0.0, -20.0, 0.0, 10.0, 0.0, 17.0, 0.0)  # a part shows two
    volts = np.repeat(levels, (1000, *(5000, 3500) * 5))
    fine, w, seen, out = 2, 0.0, 0.0, np.zeros(volts.size)
    keep, hold = np.exp(-1 / rate / fine / lag), np.exp(-1 / rate / fine / smooth)
    for k in range(1, volts.size):
        for _ in range(fine):
            way = np.sign(w) if w else np.sign(volts[k])
            static = 0.58 if way > 0 else 0.42
            if w == 0.0 and abs(volts[k]) <= static:
                after = 0.0
            else:
                after = keep * w + (1 - keep) * gain * (volts[k] - static * way)
            w = 0.0 if after * way < 0.0 else after
            seen = hold * seen + (1 - hold) * w
        out[k] = seen
    speed = out + 0.5 * rng.standard_normal(volts.size)
    found = estimate(Record("motor", np.arange(volts.size) / rate, volts, velocity=speed))
    for name, true in (("time_constant", lag), ("sensor_lag", smooth), ("dc_gain", gain)):
        q = found.combinations[name]
        assert abs(q.value - true) < 4 * q.std + 1e-3 * true  # four deviations, and the fine steps'
        assert q.std < 0.05 * true
