"""The compiled recursion: events inside the step, delay and window, against other means."""

from dataclasses import replace

import independent
import motors
import numpy as np
import pytest
from scipy.signal import lfilter

from smp_motor_ident._compile import OPTIONS
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.likelihood.first_order_lag import lagged
from smp_motor_ident.likelihood.noise import NO_GAIN, NoiseModel, deviance, kalman_gain
from smp_motor_ident.likelihood.passes import answers, evaluate, gather
from smp_motor_ident.model.coordinates import LOGARITHMS, NAMES, Coordinates
from smp_motor_ident.model.measurement import ANGLE, MEAN_SPEED, SPEED
from smp_motor_ident.model.physical import from_physical
from smp_motor_ident.model.structures import SENSORS, Electromechanical, FirstOrder, SecondOrder
from smp_motor_ident.record import Record


def predict(data, structure, z, gain=NO_GAIN):
    out = np.zeros((data.size, 3))
    gather(data, structure, z, data.initial, NoiseModel(gain=gain), out, differentiate=False)
    return out


def exact(wheel="front_left", static_voltage=0.5, kind="fourier", seconds=4.0):
    recording = motors.record(wheel, kinds=(kind,), seconds=seconds, static_voltage=static_voltage)
    data = prepare([recording], True)
    data = replace(data, initial=np.zeros((1, 5)))
    p = independent.TABLE_1[wheel]
    z = from_physical(*p, static_voltage * p[2] / p[0])
    return recording, data, z


@pytest.mark.parametrize("kind", ["sine", "square", "fourier"])
def test_sticking_and_reversal_inside_the_step_match_a_simulation_in_small_steps(kind):
    recording, data, z = exact(kind=kind)
    structure = Electromechanical()
    r, el, k, j, b = independent.TABLE_1["front_left"]
    small = independent.simulate(
        recording.time, recording.voltage, r, el, k, j, b, 0.5 * k / r,
        np.zeros(len(recording)), 400,
    )  # fmt: skip
    out = predict(data, structure, z)
    # The small steps (12.5 us) start from rest up to one step late: 1e-4 of the speed's range.
    np.testing.assert_allclose(out[:, 0], small[:, 1], atol=0.05)
    np.testing.assert_allclose(out[:, 1], small[:, 2], atol=2e-3)


@pytest.mark.parametrize("delay", [0.0, 0.0033, 0.0121])
@pytest.mark.parametrize("with_gain", [False, True])
def test_gradient_is_that_of_finite_differences_through_all_events(delay, with_gain):
    _, data, z = exact(seconds=3.0)
    structure = Electromechanical(delay=delay > 0, offset=True, load=True)
    matrix = structure.matrix
    z = structure.complete(z).with_(delay=delay)
    z = z.moved(matrix @ np.full(matrix.shape[1], 1e-3))
    gain = NO_GAIN.copy()
    if with_gain:
        gain, _ = kalman_gain(structure, z, ANGLE, data.step, 1e7, 0.5)

    def run(at):
        return gather(data, structure, at, data.initial, NoiseModel(np.diag([1e-4, 1e-4]), gain))

    gradient = run(z).gradient
    for j in range(matrix.shape[1]):
        step = 1e-6 if structure.free[j] in LOGARITHMS[:4] else 1e-7
        up, down = (run(z.moved(way * step * matrix[:, j])).cost for way in (1, -1))
        numeric = -0.5 * (up[0] - down[0]) / (2 * step)
        scale = np.abs(gradient[0]).max()
        # A whole delay of samples and the sticking have kinks; elsewhere 1e-3 is rounding.
        assert gradient[0, j] == pytest.approx(numeric, rel=2e-3, abs=1e-6 * scale)


def test_delay_of_whole_samples_equals_a_shifted_input():
    recording, data, z = exact(static_voltage=0.3)
    structure = SecondOrder(delay=True)
    z = structure.complete(z)
    late = z.with_(delay=2 * data.step)
    v = recording.voltage
    shifted = replace(recording, voltage=np.concatenate([[v[0], v[0]], v[:-2]]), current=None)
    plain = replace(prepare([shifted], False), initial=np.zeros((1, 5)))
    a = predict(replace(data, current=np.zeros(0)), structure, late)
    b = predict(plain, structure, z)
    np.testing.assert_allclose(a[:, 0], b[:, 0], atol=1e-8)


def test_mean_speed_over_a_window_is_the_difference_of_angles():
    _, data, z = exact(static_voltage=0.0)
    structure = SecondOrder(friction="none", window=True)
    z = structure.complete(z).with_(window=4 * data.step)
    data = replace(data, current=np.zeros(0))
    angle = predict(replace(data, kind=ANGLE), structure, z)[:, 1]
    mean = predict(replace(data, kind=MEAN_SPEED), structure, z)[:, 1]
    np.testing.assert_allclose(mean[4:], (angle[4:] - angle[:-4]) / (4 * data.step), rtol=1e-9)


def test_irregular_stamps_are_taken_as_they_are():
    rng = np.random.default_rng(3)
    t = np.cumsum(0.005 + 0.002 * rng.uniform(-1, 1, 800))
    v = independent.excitation(t, "square")
    p = independent.TABLE_1["rear_right"]
    small = independent.simulate(t, v, *p, 0.2 * p[2] / p[0], np.zeros(t.size), 200)
    recording = replace(motors.record(seconds=2.0), time=t, voltage=v, velocity=None,
                        current=small[:, 0], count=np.zeros(800, dtype=np.int64))  # fmt: skip
    recording = replace(recording, count=(small[:, 2] / motors.QUANTUM).astype(np.int64))
    data = replace(prepare([recording], True), initial=np.zeros((1, 5)))
    z = from_physical(*p, 0.2 * p[2] / p[0])
    out = predict(data, Electromechanical(), z)
    np.testing.assert_allclose(out[:, 0], small[:, 1], atol=0.05)  # as above


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_motor_at_rest_goes_where_more_than_its_friction_pulls_however_that_fades(sign):
    t = np.arange(200) / 1000.0
    data = prepare([Record("motor", t, np.full(200, 3.0 * sign), velocity=0 * t)], False)
    structure = SecondOrder(load=True)
    z = structure.complete(
        Coordinates(*np.log([0.05, 2e-3, 4e-7])).with_friction(0.5).with_(load=-0.2, ln_te=-8.5)
    )
    ends = []
    for voltage in (3.0, 3.0 + 1e-9, 3.2):  # over the winding, towards the 3 V of the supply
        begins = np.array([[sign * voltage, 0.0, 0.0, 0.0, 0.0]])
        ends.append(predict(replace(data, initial=begins), structure, z)[-1, 0])
    assert sign * ends[0] > 10.0
    np.testing.assert_allclose(ends, ends[0], rtol=1e-3)


def test_coordinates_that_are_no_numbers_are_no_motor_and_no_crash():
    data = prepare([motors.record("rear_left", current=False, seconds=1.0)], False, "speed")
    data = data.measured_as(MEAN_SPEED)
    structure = FirstOrder(window=True)
    z = Coordinates.of(np.full(len(NAMES), np.nan))  # as a descent's overflow leaves it
    found = evaluate(data, structure, z, data.initial, data.initial, NoiseModel())
    assert found.objective == np.inf


@pytest.mark.parametrize("resistance", [-80.0, 80.0])
def test_a_motion_that_is_no_number_ends_the_pass_and_is_no_motor(resistance):
    _, data, z = exact(seconds=1.0)
    # Corrections by a current of 1e35 A, or by one of none, a thousand times over.
    gain = np.array([[0.0, 1e3], [0.0, 1e3], [1e3, 1e3]])
    noise = NoiseModel(gain=gain)
    wild = z.with_(ln_r=resistance)
    assert evaluate(
        data, Electromechanical(), wild, data.initial, data.initial, noise
    ).objective == np.inf  # fmt: skip
    out = predict(data, Electromechanical(), wild, gain)
    assert np.isnan(out[-1]).all()


def test_a_beginning_that_has_faded_is_nothing_and_costs_nothing():
    recording = motors.record("rear_right", current=False, kinds=("sine",), seconds=60.0)
    data = prepare([recording], False, "speed")
    structure = SecondOrder()
    z = from_physical(*independent.TABLE_1["rear_right"])
    sums = gather(data, structure, z, data.initial)
    own = np.abs(sums.scores[-1, -2:])
    # After a thousand time constants; a number that is not normal would take ten times as long.
    assert not own.any()


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("with_gain", [False, True])
def test_answer_to_a_signal_is_what_little_of_it_changes(sensor, with_gain):
    _, data, z = exact(static_voltage=0.3, kind="sine", seconds=3.0)
    structure = Electromechanical(current_sensor=sensor, delay=True)
    z = z.with_(delay=0.3 * data.step, current_lag=0.7 * data.step)
    gain = kalman_gain(structure, z, ANGLE, data.step, 1e7, 0.5)[0] if with_gain else NO_GAIN
    signal = np.cos(3 * data.hold_end)
    shown = 1e-2 * np.sin(5 * data.time)
    found = answers(
        data, structure, z, data.initial, NoiseModel(gain=gain),
        (signal[None], np.array([shown, 0 * shown])[:, None]), 7, False,
    )[:, :, 0]  # fmt: skip
    size = 1e-4
    nudged = replace(
        data, hold_value=data.hold_value + size * signal, output=data.output - size * shown
    )
    change = (predict(nudged, structure, z, gain) - predict(data, structure, z, gain)) / size
    change[:, 1] += shown
    rows = np.arange(0, data.size, 7)
    for output in (0, 1):
        expected = np.add.reduceat(change[:, 1 + output], rows)
        # A stop or a start that comes a little earlier or later bends the answer.
        assert np.abs(found[:, output] - expected).max() < 2e-3 * np.abs(expected).max()


@pytest.mark.parametrize("kind", [SPEED, ANGLE])
@pytest.mark.parametrize("order", [FirstOrder, SecondOrder])
def test_answers_of_a_motor_that_only_slides_are_those_of_the_pass_with_events(kind, order):
    _, data, z = exact(static_voltage=0.0, kind="sine", seconds=2.0)
    held = np.sort(np.r_[data.time[:-1], data.time[-1]] + 1e-4 * np.sin(np.arange(data.size)))
    output = np.where(np.arange(data.size) % 7 == 3, np.nan, data.output)
    data = replace(data, kind=kind, time=held, hold_end=held, output=output, current=np.zeros(0))
    z, signals = z.with_friction(0.0), np.cos(np.outer([3.0, 40.0], held))
    beside = signals, np.zeros((0, 0, 0))
    found = [
        answers(data, s, s.complete(z), data.initial, NoiseModel(), beside, 7, False)
        for s in (order(friction="none"), order())
    ]
    # The second pass locates turns, of which no friction makes anything.
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-9 * np.abs(found[1]).max())


@pytest.mark.parametrize("size", [1.0, 1e90])
def test_the_deviance_of_two_outputs_is_that_of_their_covariance_however_far_off(size):
    rng = np.random.default_rng(7)
    first, second = rng.multivariate_normal([0.0, 0.0], [[4.0, 1.5], [1.5, 9.0]], 50).T
    spread = np.array([first @ first, second @ second, first @ second, 50.0, 50.0, 50.0])
    covariance = np.cov(first, second, bias=True) + np.outer(*[[first.mean(), second.mean()]] * 2)
    found = deviance(spread * np.repeat([size**2, 1.0], 3))
    assert found == pytest.approx(50 * (np.linalg.slogdet(covariance)[1] + 4 * np.log(size)))


@pytest.mark.parametrize("delay", [False, True])
def test_what_rests_leaves_no_numbers_below_the_normal_ones(delay):
    """They cost ten times as much each, in whatever of a long rest is computed after them."""
    t = 1e-3 * np.arange(20_000)
    voltage = np.where(t < 1.0, 6.0, 0.0)
    data = prepare([Record("m", t, voltage, velocity=np.zeros(t.size))], False)
    data = replace(data, initial=np.zeros((1, 5)))
    structure = SecondOrder(friction="none", delay=delay)
    z = from_physical(1.0, 2e-3, 0.1, 1e-4, 1e-4).with_friction(0.0)
    assert z.time_constant < 0.01  # the least number is 745 of them away
    beside = np.where(t < 0.5, 1.0, 0.0)[None], np.zeros((0, 0, 0))
    noise = NoiseModel()
    shown = [
        predict(data, structure, z)[:, :2],
        answers(data, structure, z, data.initial, noise, beside, 1, False),
        answers(data, structure, z, data.initial, noise, (np.zeros((0, 0)), beside[1]), 1, True),
        lagged(voltage, 20.0),
    ]
    for values in shown:
        size = np.abs(values)
        assert size.max() > 1e-3 and not size[-1].any()
        assert size[size > 0].min() > 1e-300


def test_a_lag_is_that_of_a_filter_of_first_order():
    values = np.random.default_rng(3).standard_normal(300)
    keeps = np.exp(-1 / 7.5)
    np.testing.assert_allclose(
        lagged(values, 7.5), lfilter([1 - keeps], [1, -keeps], values), rtol=1e-12
    )
    assert lagged(values, 0.0) is values


def test_sensitivities_of_each_sample_are_the_same_from_both_passes():
    recording = motors.record("rear_left", current=False, seconds=2.0)
    data = prepare([recording], False)
    data.output[100:120] = np.nan
    z = from_physical(*independent.TABLE_1["rear_left"]).with_friction(0.0)
    none = np.zeros((0, 0)), np.zeros((0, 0, 0))
    found = []
    for delay in (False, True):
        structure = SecondOrder(friction="none", load=True, delay=delay)
        own = answers(data, structure, structure.complete(z), data.initial, NoiseModel(), none, 1,
                      True)  # fmt: skip
        free = [n for n, c in enumerate(structure.free) if c != "delay"]
        found.append(own[:, 0, [*free, len(structure.free), len(structure.free) + 1]])
    size = np.abs(found[0]).max(axis=0)
    np.testing.assert_allclose(found[0] / size, found[1] / size, atol=1e-12)
    assert not found[0][100:120].any()


def test_sums_keep_their_order_wherever_a_function_was_compiled_into() -> None:
    """Else the first run, which compiles, and the next, which loads, differ in the last digit."""
    assert set(OPTIONS["fastmath"]) <= {"nsz", "nnan", "ninf"}
