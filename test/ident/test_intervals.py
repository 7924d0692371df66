"""Intervals say what the data tell: neither what a counter repeats nor what a model leaves out."""

from dataclasses import replace

import independent
import motors
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2, norm

from smp_motor_control.excitation import Fourier
from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.diagnosis.identifiability import what_next
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.consider_covariance import (
    above_zero,
    consider_current_lag,
    consider_hold,
    consider_left_out,
    mean_square,
)
from smp_motor_ident.estimation.fitted import Options, long_run
from smp_motor_ident.estimation.hold_choice import instant_deviation
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.prediction import inverse, predicted_decrease
from smp_motor_ident.estimation.quantisation import widened
from smp_motor_ident.estimation.thinning import thinned
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import Electromechanical, FirstOrder, SecondOrder
from smp_motor_ident.record import Hardware, Record


def test_a_friction_that_does_not_show_is_nothing_within_an_interval():
    recording = motors.record("rear_left", current=False, static_voltage=0.0, torque_noise=0.5)
    friction = estimate(recording).combinations["static_voltage"]
    # 0.5 V of torque noise over 3000 samples leave hundredths of a volt open, not nothing.
    assert 1e-3 < friction.std < 0.1
    assert friction.ci95[0] == 0.0
    assert friction.value < 3 * friction.std


def test_two_exact_speeds_widen_the_interval_where_the_counter_repeats_itself():
    # A square wave in step with the sampling: the same counts again and again.
    t = np.arange(2000) / 200.0
    square = 12.0 * np.sign(np.sin(2 * np.pi * (t + 1e-6)))
    wide = estimate(motors.record("front_left", voltage=square, kinds=("x",) * 2))
    wander = square * (1 + 0.05 * np.sin(2 * np.pi * 0.11 * t))
    narrow = estimate(motors.record("front_left", voltage=wander, kinds=("x",) * 2))
    truth = motors.truth("front_left", 0.3)["dc_gain"]
    for e in (wide, narrow):
        assert abs(e.value("dc_gain") - truth) < 4 * e.combinations["dc_gain"].std
    assert wide.combinations["dc_gain"].std > 1.3 * narrow.combinations["dc_gain"].std


def test_motors_out_of_all_bounds_are_not_replayed():
    """A lag that the data leave open by a factor of e^1000 is none whose counts can be drawn."""
    square = 12.0 * np.sign(np.sin(2 * np.pi * (np.arange(600) / 200.0 + 1e-6)))
    recording = motors.record("front_left", current=False, voltage=square, kinds=("x",) * 2)
    data = prepare([recording], False)
    fit = initial_fit(data, SecondOrder(friction="symmetric"), Options())
    assert fit is not None
    fit = replace(fit, noise_ratio=0.0, noise=np.diag([data.quantum**2 / 12, 1.0]))
    free = len(fit.structure.free)
    assert widened(data, fit).widen is not None
    # Where angles are infinite, and where they are past what a counter of 53 bits can hold.
    for loose, by in ((1, 1e6), (0, 1e4)):
        far = replace(fit, added=np.diag(np.where(np.arange(free) == loose, by, 0.0)))
        assert np.isfinite(widened(data, far).widen).all()


def test_what_nothing_is_known_of_takes_no_part_in_an_inverse():
    normal = np.array([[4.0, 0.0, 2.0], [0.0, 1e-280, 1e-150], [2.0, 1e-150, 3.0]])
    expected = np.zeros((3, 3))
    expected[np.ix_([0, 2], [0, 2])] = np.array([[3.0, -2.0], [-2.0, 4.0]]) / 8.0
    np.testing.assert_allclose(inverse(normal), expected, rtol=1e-12, atol=1e-15)


def test_thinning_keeps_the_charge_and_the_jumps_of_the_input():
    recording = motors.record(
        "rear_left", current=False, rate=5000.0, seconds=2.0, kinds=("square",)
    )
    few = replace(recording.hardware, counts_per_revolution=None)
    angle = recording.count * motors.QUANTUM
    data = prepare(
        [replace(recording, count=None, velocity=None, position=angle, hardware=few)], False
    )
    thin = thinned(data)
    assert data.kind == ANGLE
    assert thin.size < data.size / 4
    charge = [float(np.sum(d.hold_value[1:] * np.diff(d.hold_end))) for d in (data, thin)]
    # The last sample that is kept ends a few samples, of 10 V each, before the last one.
    assert abs(charge[0] - charge[1]) <= 10.0 * (data.time[-1] - thin.time[-1]) + 1e-9
    levels = [set(np.round(d.hold_value, 9)) for d in (data, thin)]
    assert levels[0] == levels[1]


def test_an_oversampled_motor_is_recovered_without_current():
    recording = motors.record(
        "rear_left", current=False, rate=5000.0, seconds=1.5, torque_noise=0.5
    )
    result = estimate(recording)
    truth = motors.truth("rear_left", 0.3)
    for name in ("dc_gain", "time_constant", "static_voltage"):
        q = result.combinations[name]
        assert abs(q.value - truth[name]) < 4 * q.std, name  # as in test_estimate


def test_following_a_proposal_brings_what_it_promised():
    # front_right: K is 3 % of what limits the speed, which voltage and speed do not tell.
    first = estimate(motors.record("front_right", current=False))
    proposal = what_next(first, accuracy=0.05)
    t = np.arange(int(proposal.duration * 200.0)) / 200.0
    tones = Fourier(
        amplitude=proposal.amplitude, lowest=proposal.band[0], highest=proposal.band[1], tones=16
    )
    then = estimate(motors.record("front_right", voltage=tones(t), seconds=proposal.duration))
    truth = motors.truth("front_right", 0.3)
    for name in PHYSICAL:
        q = then.parameters[name]
        # The tones are not the trial's own, and quantisation repeats a little: half more.
        assert q.std < 1.5 * proposal.relative_std[name] * truth[name], name


def test_stated_deviations_are_those_of_repeated_recordings():
    """Errors of 20 recordings in stated deviations: twice too wide fails as twice too narrow."""
    wander = motors.record("front_left", kinds=("fourier", "square"), seconds=2.0).voltage
    truth = motors.truth("front_left", 0.3)
    names = ("dc_gain", "time_constant", "static_voltage")
    errors = []
    for seed in range(20):
        recording = motors.record("front_left", voltage=wander, torque_noise=0.5, seed=seed)
        e = estimate(replace(recording, current=None), model="second_order")
        errors.append([(e.value(n) - truth[n]) / e.combinations[n].std for n in names])
    scatter = np.sqrt(np.mean(np.square(errors), axis=0))
    # sqrt(chi2(20) / 20) lies outside of 0.54 to 1.51 in one of 500 cases.
    low, high = np.sqrt(chi2.ppf([1e-3, 1 - 1e-3], 20) / 20)
    assert np.all((low < scatter) & (scatter < high)), dict(zip(names, scatter, strict=True))


@pytest.mark.parametrize("share", [0.0, 0.4, 0.7])
def test_what_outlasts_a_run_of_samples_counts(share: float):
    """The total of n terms of an AR(1) process has n / (1 - share)^2 of its noise's variance."""
    rng = np.random.default_rng(3)
    sums = np.zeros((60, 500))
    sums[0] = rng.standard_normal(500) / np.sqrt(1 - share**2)
    for k in range(1, 60):
        sums[k] = share * sums[k - 1] + rng.standard_normal(500)
    spread = np.median(long_run(sums)) * (1 - share) ** 2 / 60
    alone = np.median(np.square(sums).sum(axis=0)) * (1 - share) ** 2 / 60
    # Bartlett's weights leave some of a long memory out; chance adds a little where there is none.
    assert spread < 1.1
    assert spread - alone > 0.4 * (1 - alone), (spread, alone)


def test_a_delay_not_worth_its_price_is_in_the_interval():
    """Of what is late by three of its deviations selection keeps nothing; the lags bear it.

    Where the score says nothing of a delay that the data would show, next to nothing is left open.
    """
    data = prepare([motors.record("rear_left", current=False, seconds=2.0)], False)
    structure = SecondOrder(friction="symmetric")
    late = structure.with_(delay=True)
    fit = initial_fit(data, structure, Options())
    step, cov = predicted_decrease(data, fit, late)[1:]
    std = float(np.sqrt(cov[late.free.index("delay"), late.free.index("delay")]))
    for times in (0.0, 3.0):
        shift = times * std - step[late.free.index("delay")]  # after which the score says so
        moved = replace(data, hold_end=data.hold_end - shift)
        wider = consider_left_out(moved, replace(fit, added=None))
        lags = wider.conditional()[2, 2] / fit.conditional()[2, 2]
        assert 1.0 < lags < 1.1 if times == 0.0 else lags > 2.0


@pytest.mark.parametrize("late, noise", [(0.0, 1e-4), (3.0, 3e-3)])
def test_a_delay_in_the_place_of_a_second_lag_is_as_long_at_most(late, noise):
    """A finely known angle shows 20 us in rows of 5 ms: winding or delay, never ms of either."""
    rng = np.random.default_rng(4)
    t = np.arange(2800) / 200.0
    volts = np.repeat([0.0, 12.0, -24.0, 16.0, -36.0, 8.0, 28.0], 400)
    volts = independent.excitation(t, "fourier", 36.0) if late else volts
    motion = independent.simulate(t, volts, 1.0, 2e-5, 0.2, 0.004, 1e-3, 0.0, np.zeros(t.size), 500)
    angle = motion[:, 2] + noise * rng.standard_normal(t.size)
    data = prepare([Record("motor", t, volts, position=angle)], False)
    fit = initial_fit(data, SecondOrder(friction="none"), Options())
    lag = fit.structure.of_free(np.eye(12)[2] - np.eye(12)[1])  # its logarithm, beside a short a1
    std = float(np.sqrt(lag @ fit.covariance() @ lag))
    assert abs(np.log(fit.z.second_lag / 2e-5)) < 4 * std
    assert std < 0.5  # it is there
    richer = fit.structure.with_(delay=True)
    step, cov = predicted_decrease(data, fit, richer)[1:]
    at = richer.free.index("delay")
    # As far from none as chance puts one delay in twenty: Akaike has it in the interval.
    shift = late * float(np.sqrt(cov[at, at])) - step[at] if late else 0.0
    moved = replace(data, hold_end=data.hold_end - shift)
    row = fit.structure.of_free(np.eye(12)[1] - np.eye(12)[0]) * fit.z.time_constant
    fit = replace(fit, added=None)
    own, wider = fit.conditional(), consider_left_out(moved, fit).conditional()
    both = np.hypot(np.sqrt(row @ own @ row), fit.z.second_lag)
    assert np.sqrt(row @ wider @ row) < 1.05 * both  # a left-out load adds little


@pytest.mark.parametrize("found, deviation", [(0.3, 0.02), (0.0, 0.05), (0.2, 0.1), (-0.5, 2.0)])
def test_a_delay_within_a_sample_is_none_or_any_part_of_it(found, deviation):
    def likely(d):
        return norm.pdf(d, found, deviation)

    none, some = likely(0.0), quad(likely, 0.0, 1.0, points=[found])[0]
    square = quad(lambda d: d * d * likely(d), 0.0, 1.0, points=[found])[0]
    step = 3e-3
    open_left = mean_square(found * step, (deviation * step) ** 2, step)
    assert open_left == pytest.approx(square / (none + some) * step**2, rel=0.01)


def test_stamps_that_scatter_leave_the_instant_of_one_step_open():
    rng = np.random.default_rng(5)
    t = np.arange(1000) / 500.0 + 2e-4 * rng.standard_normal(1000)
    t = np.sort(t) - t.min()
    step = Record("motor", t, np.r_[np.zeros(300), np.full(700, 5.0)], velocity=0 * t)
    many = replace(step, voltage=5.0 * np.sign(np.sin(40 * t)))
    # A stamp's own deviation for one step; divided by the root of their number for many.
    assert 1e-4 < instant_deviation([step], "held") < 4e-4
    assert instant_deviation([many], "held") < 1e-4


def _rounded(seed: int) -> tuple[Record, dict[str, float]]:
    """A motor of first order at four speeds, which are given in steps of 4 rad/s."""
    rng = np.random.default_rng(seed)
    gain, lag, friction, rate = 7.0 * rng.uniform(0.8, 1.2), 0.017, 1.0, 500.0
    volts = np.repeat(rng.choice([8.0, 12.0, 16.0, 20.0], 12), 100)
    keep, w = np.exp(-1 / rate / lag), np.zeros(volts.size)
    for k in range(1, w.size):
        w[k] = keep * w[k - 1] + (1 - keep) * gain * (volts[k] - friction)
    shown = 4.0 * np.rint((w + 0.3 * rng.standard_normal(w.size)) / 4.0)
    truth = {"dc_gain": gain, "static_voltage": friction, "time_constant": lag}
    return Record("motor", np.arange(w.size) / rate, volts, velocity=shown), truth


def test_a_rounded_speed_is_not_averaged_where_the_motor_keeps_it() -> None:
    for seed in range(8):
        record, truth = _rounded(seed)
        found = estimate(record)
        for name, true in truth.items():
            q = found.combinations[name]
            # 5 standard deviations are a wrong number; 14 of them were one of the eight.
            assert q.value is None or abs(q.value - true) < 5 * q.std, (seed, name)


def test_differences_of_counts_are_averaged_where_a_speed_is_nearly_whole_counts_a_sample() -> None:
    rng = np.random.default_rng(4)
    gain, lag, step, turn = 103.0, 0.0215, 1e-3, 2 * np.pi / 44
    t = np.arange(8000) * step
    volts = np.repeat([0.0, 4.2, 0.0, -4.2, 0.0, 4.2, 0.0, -4.2], 1000)  # 3 counts a sample
    # Friction that varies with the angle moves the count of seconds by more than its rounding.
    angle, speed, counts = rng.uniform(0.0, turn), 0.0, []
    for u in volts:
        rubs = 0.11 * (1 + 0.2 * np.sin(angle / 30))
        towards = gain * (u - np.sign(speed or u) * rubs) if abs(u) > rubs or speed else 0.0
        after = towards + (speed - towards) * np.exp(-step / lag)
        speed = 0.0 if after * speed < 0 else after
        angle += speed * step
        counts.append(np.floor(angle / turn))
    shown = np.diff(counts, prepend=counts[0]) * turn / step
    found = estimate(Record("motor", t, volts, velocity=shown))
    # The rounding of a motor that stands half of the time is no scatter of its commands.
    assert all(f.code != "command_jitter" for f in found.findings)
    for name, true, share in (("dc_gain", gain, 0.02), ("time_constant", lag, 0.06)):
        q = found.combinations[name]
        assert abs(q.value - true) < 4 * q.std < 4 * share * true, name


@pytest.mark.parametrize("seed", [0, 1])
def test_a_current_in_steps_of_what_a_motor_takes_is_not_averaged(seed: int) -> None:
    R, L, K, J, B, TC = 18.4, 6.9e-3, 0.034, 5.1e-6, 8e-6, 1.3e-3
    rng = np.random.default_rng(seed)
    t = np.arange(4000) / 1000.0
    volts = np.repeat(rng.uniform(6.0, 21.0, 8), 500)
    motion = independent.simulate(t, volts, R, L, K, J, B, TC, np.zeros(t.size), 20)
    count = np.floor(motion[:, 2] * 500 / (2 * np.pi) + rng.uniform()).astype(np.int64)
    shown = 0.12 * np.rint(motion[:, 0] / 0.12)  # it takes 0.05 to 0.2 A at these speeds
    found = estimate(Record("motor", t, volts, shown, count=count, hardware=Hardware(1.0, 500.0)))
    for name, true in (("motor_constant", K), ("inertia", J), ("resistance", R)):
        q = found.parameters[name]
        assert abs(q.value - true) < 4 * q.std, name  # 49 and 33 of the motor constant's before


def test_a_speed_that_is_a_difference_of_counts_is_right_on_average() -> None:
    record = motors.record("rear_left", current=False, seconds=3.0)
    data = prepare([replace(record, count=None)], False)
    assert data.quantum > 0
    fit = initial_fit(data, FirstOrder(), Options())
    assert widened(data, fit) is fit


def test_friction_that_noise_puts_below_nothing_leaves_the_motor_as_open_as_it_is():
    """A winding's noise of 0.2 A makes a motor that pushes itself of one that hardly rubs."""
    R, L, K, J, B, TC = 2.0, 4e-3, 0.04, 8e-4, 4e-5, 0.02
    rng = np.random.default_rng(4)
    t = np.arange(600) / 200.0
    volts = independent.excitation(t, "fourier", 9.0, 4)
    motion = independent.simulate(t, volts, R, L, K, J, B, TC, np.zeros(t.size), 200)
    count = np.floor(motion[:, 2] * 48 / (2 * np.pi) + rng.uniform()).astype(np.int64)
    amps = motion[:, 0] + 0.2 * rng.standard_normal(t.size)
    found = estimate(Record("motor", t, volts, amps, count=count, hardware=Hardware(1.0, 48.0)))
    for name, true in (("motor_constant", K), ("inertia", J), ("resistance", R)):
        q = found.parameters[name]
        assert abs(q.value - true) < 3 * q.std < 0.3 * true, name  # known, and no better
    rubs = found.parameters["viscous_friction"]
    assert rubs.value is None or abs(rubs.value - B) < 3 * rubs.std


@pytest.mark.parametrize("value, deviation", [(-0.1, 1.0), (-3e-3, 2e-3), (-8.0, 1.0)])
def test_what_is_positive_is_as_large_as_its_own_square_says(value, deviation):
    whole = norm.sf(0.0, value, deviation)
    square = quad(lambda x: x * x * norm.pdf(x, value, deviation), 0.0, 9 * deviation)[0]
    assert above_zero(value, deviation) == pytest.approx(np.sqrt(square / whole), rel=1e-6)


def test_what_is_far_below_nothing_is_exponential_above_it():
    # The density falls by e in deviation^2 / |value|, and a mean square is twice that squared.
    for value in (-990.0, -1010.0):
        assert above_zero(value, 1.0) == pytest.approx(np.sqrt(2) / -value, rel=1e-4)


def test_a_second_lag_hangs_on_how_a_command_ran_between_its_rows():
    """Where a misfit is shown, a command that seems interpolated may be one that was held."""
    data = prepare([motors.record("rear_left", current=False, seconds=2.0)], False)
    fit = initial_fit(data, SecondOrder(friction="none"), Options())
    assert fit is not None and consider_hold(data, fit) is fit
    ran = replace(fit, structure=fit.structure.with_(held="interpolated"))
    added = consider_hold(data, ran).added
    assert added is not None
    lag = np.sqrt(np.diag(added))[ran.structure.free.index("ln_a2")] * fit.z.second_lag
    # Anything from none to half a row: the root of the mean square of that is half over root 3.
    np.testing.assert_allclose(lag, 0.5 * data.step / np.sqrt(3))
    assert np.count_nonzero(added) == 1


def test_a_current_that_is_later_than_its_model_leaves_the_windings_lag_unknown():
    """L/R and a sensor's lag are one lag of the current: an e-fold of it is no value."""
    data = prepare([motors.record("rear_left", seconds=2.0)], True)
    fit = initial_fit(data, Electromechanical(), Options())
    assert fit is not None
    added = consider_current_lag(fit).added
    assert added is not None
    moved = dict(zip(fit.structure.free, np.sqrt(np.diag(added)), strict=True))
    assert {name: m for name, m in moved.items() if m} == {"ln_a2": 1.0, "ln_te": 1.0}


def test_friction_that_a_play_before_the_encoder_hides_is_not_known_to_be_none() -> None:
    """Crossing the play after each reversal stands for friction: less than none would fit best."""
    rate, fine, n, tau, gain, friction, play = 200.0, 50, 2600, 0.079, 1.95, 0.6, 0.02
    volts = np.repeat(np.where((np.arange(n) // 80) % 2, -7.4, 7.4), fine)
    step = 1 / rate / fine
    keep, w = np.exp(-step / tau), np.zeros(volts.size)
    for k in range(1, w.size):
        push = volts[k] - friction * np.sign(w[k - 1] or volts[k])
        w[k] = keep * w[k - 1] + (1 - keep) * gain * push
    angle, seen = np.cumsum(w) * step, np.zeros(w.size)
    for k in range(1, w.size):
        seen[k] = min(max(seen[k - 1], angle[k] - play), angle[k] + play)
    speed = np.diff(seen[::fine], prepend=0.0) * rate
    noisy = speed + 0.05 * np.random.default_rng(0).standard_normal(n)
    found = estimate(Record("motor", np.arange(n) / rate, volts[::fine], velocity=noisy))
    static = found.combinations["static_voltage"]
    assert "conditions" in {f.code for f in found.findings} and not found.unreliable
    assert abs(static.value - friction) < 3 * static.std < 3 * friction
