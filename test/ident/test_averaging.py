"""Candidates that explain the data alike are all covered by what is stated."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.averaging import (
    averaged,
    candidate_weights,
    covering,
    left_open,
    weights,
)
from smp_motor_ident.estimation.fitted import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.quantities import Answer, answer
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.structures import Electromechanical, FirstOrder, SecondOrder
from smp_motor_ident.record import Record
from smp_motor_ident.result import Quantity


def _answer(lag: float, delay: float | None) -> Answer:
    combinations = {"time_constant": Quantity(lag, 0.001, (lag - 0.00196, lag + 0.00196), "s")}
    if delay is not None:
        combinations["delay"] = Quantity(delay, 0.001, (delay - 0.00196, delay + 0.00196), "s")
    names = tuple(combinations)
    return Answer({}, combinations, names, 1e-6 * np.eye(len(names)))


def test_a_lag_that_may_be_a_delay_is_stated_with_both():
    both = averaged(_answer(0.05, 0.01), np.array([0.6, 0.4]), [_answer(0.06, None)])
    lag, delay = both.combinations["time_constant"], both.combinations["delay"]
    # Means and variances of a mixture, by its definition.
    np.testing.assert_allclose(lag.value, 0.6 * 0.05 + 0.4 * 0.06)
    np.testing.assert_allclose(lag.std**2, 0.001**2 + 0.6 * 0.4 * 0.01**2)
    np.testing.assert_allclose(delay.value, 0.6 * 0.01)
    # What is late in all stays as well known as it was: the two go against each other.
    assert both.covariance[0, 1] < 0
    np.testing.assert_allclose(both.covariance[0, 1], -0.6 * 0.4 * 0.01 * 0.01)


def test_what_is_likelier_than_the_choice_and_knows_less_counts_with_what_it_knows():
    vague = replace(_answer(0.06, None), covariance=25e-6 * np.eye(1))
    for weight in (0.25, 0.75):
        both = averaged(_answer(0.05, 0.01), np.array([1 - weight, weight]), [vague])
        within = 0.25 * 0.001**2 + 0.75 * 0.005**2 if weight > 0.5 else 0.001**2
        lag = both.combinations["time_constant"]
        np.testing.assert_allclose(lag.std**2, within + 0.25 * 0.75 * 0.01**2)


def test_a_choice_that_is_all_but_rejected_stays_inside_of_the_interval():
    both = averaged(_answer(0.05, 0.01), np.array([0.001, 0.999]), [_answer(0.06, None)])
    lag = both.combinations["time_constant"]
    off = abs(lag.value - 0.05)
    assert 1.9 * lag.std < off < 1.96 * lag.std  # 95 % of a normal variable


def test_a_candidate_that_is_rejected_changes_nothing():
    alone = _answer(0.05, 0.01)
    assert averaged(alone, np.array([0.999, 0.001]), [_answer(0.06, None)]) is alone


def test_a_second_lag_that_the_choice_does_not_have_is_left_open_as_far_as_another_has_it():
    second = _answer(0.05, None)
    second.combinations["time_constant_product"] = Quantity(2e-4, 1e-4, (0.0, 4e-4), "s^2")
    both = averaged(_answer(0.05, 0.01), np.array([0.8, 0.2]), [second])
    product = both.combinations["time_constant_product"]
    assert product.value is None and product.status == "unidentifiable"
    assert product.ci95 == (0.0, 4e-4)
    assert list(both.combinations) == ["delay", "time_constant", "time_constant_product"]
    rejected = averaged(_answer(0.05, 0.01), np.array([0.999, 0.001]), [second])
    assert "time_constant_product" not in rejected.combinations


def test_a_candidate_that_only_the_current_rejects_has_no_weight():
    data = prepare([motors.record("rear_left", seconds=2.0)], True)
    fit = initial_fit(data, Electromechanical(), Options())
    # Of another resistance, and all torques with it, the motor turns just alike.
    other = replace(fit, z=fit.z.with_(ln_r=fit.z.ln_r + 0.02))
    assert weights([data, data], [fit, other])[1] < 1e-6
    assert np.ptp(weights([data, data], [fit, fit])) < 1e-9


@pytest.mark.parametrize("name", ["delay", "window"])
def test_what_is_late_is_as_likely_as_a_second_lag_or_has_the_odds_of_the_choice(name):
    data = prepare([motors.record("rear_left", seconds=2.0)], False)
    fit = initial_fit(data, FirstOrder(), Options())
    data, second = replace(data, quantum=0.0), SecondOrder(shape=True)
    lag = replace(fit, structure=second, z=second.complete(fit.z.with_second_lag(1e-7)))
    late = replace(fit, structure=FirstOrder(**{name: True}))
    known = replace(fit, structure=FirstOrder(**{name: True}, fixed={name: 0.0}))
    # They answer alike: even odds or e^10 to 1 for the lag, but where the user states the other.
    assert weights([data, data], [lag, late])[1] == pytest.approx(0.25, rel=0.01)
    assert weights([data, data], [lag, known])[1] > 0.5
    # Against a motor that is not late it has the price of a parameter, with a lag beside it or not.
    price = np.exp(-0.5 * POLICY.price(1, fit.samples))
    alone, among = weights([data] * 2, [fit, late]), weights([data] * 3, [fit, late, lag])
    assert alone[1] / alone[0] == pytest.approx(price, rel=0.1)
    assert among[1:].sum() / among[0] == pytest.approx(2 * price, rel=0.1)


def test_a_candidate_that_did_not_settle_is_covered_as_far_as_it_explains_the_data():
    data = prepare([motors.record("rear_left", seconds=2.0)], True)
    fit = initial_fit(data, Electromechanical(), Options())
    # Another lag by two deviations: in likelihood a fit that is hardly worse.
    near = fit.z.with_(ln_a1=fit.z.ln_a1 + 2 * np.sqrt(fit.covariance()[1, 1]))
    unsettled = FittedCandidate(replace(fit, z=near, converged=False))
    lost = FittedCandidate(replace(fit, deviance=np.inf, converged=False))
    own = answer(fit, {})
    candidates = [lost, unsettled, FittedCandidate(fit)]
    found, _ = covering(candidate_weights(data, candidates), candidates, own, {})
    before, after = own.combinations["time_constant"], found.combinations["time_constant"]
    other = answer(unsettled.fit, {}).combinations["time_constant"].value
    assert after.std > before.std
    assert min(before.value, other) < after.value < max(before.value, other)


def test_a_delay_that_the_choice_does_not_have_is_left_open_as_far_as_the_score_leaves_it():
    command = motors.record("rear_left", seconds=2.0).voltage
    late = np.repeat(command, 2)  # by half of a row: each holds up to its stamp
    fine = motors.record("rear_left", current=False, rate=400.0, voltage=late)
    one = Record("rear_left", fine.time[::2], command, count=fine.count[::2],
                 hardware=fine.hardware)  # fmt: skip
    data = prepare([one], False)
    fit = initial_fit(data, SecondOrder(), Options())
    candidates = [FittedCandidate(fit)]
    (latest,) = left_open(data, fit, {0: 1.0}, candidates)
    (scattered,) = left_open(data, fit, {0: 1.0}, candidates, 0.004)
    assert scattered["delay"] == 0.004  # of which no score tells
    product = answer(fit, {}).combinations["time_constant_product"].value
    assert 0.0025 < latest["delay"] < 0.003
    # It stood for a longer second lag: that of the motor has 20 ms, and a product of 8.2e-4.
    assert latest["time_constant_product"] < 0.95 * product
    assert abs(latest["time_constant_product"] - 8.2e-4) < abs(product - 8.2e-4)
    known = initial_fit(data, SecondOrder(fixed={"delay": 0.0025}), Options())
    assert left_open(data, known, {0: 1.0}, candidates) == ()
    # What is rejected is none, what explains the data as well is one, after its structure.
    both = left_open(data, fit, {0: 0.6, 1: 0.4}, [FittedCandidate(fit), FittedCandidate(known)])
    assert [one.get("delay") for one in both] == [0.0025, latest["delay"]]
    lost = replace(fit, z=fit.z.with_(ln_a1=800.0))  # of a time constant that is no number
    assert left_open(data, fit, {0: 0.6, 1: 0.4}, [*candidates, FittedCandidate(lost)]) == (latest,)
    rejected = left_open(data, fit, {0: 0.99, 1: 0.01}, [*candidates, FittedCandidate(known)])
    assert rejected == (latest,)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_speed_of_whole_counts_is_a_mean_that_is_no_delay(seed):
    step, late, lag, gain, count = 0.02, 0.0205, 0.037, 2.8, 0.00224
    rng = np.random.default_rng(seed)
    levels = np.repeat(np.where(rng.integers(0, 2, 334) > 0, 2.7, 1.2), 3)[:1000]
    fine = step / 20
    drive = np.concatenate([np.full(round(late / fine), levels[0]), np.repeat(levels, 20)])
    keep, speed = np.exp(-fine / lag), np.full(20_000, gain * levels[0])
    for k in range(1, speed.size):
        speed[k] = keep * speed[k - 1] + (1 - keep) * gain * drive[k - 1]
    speed += np.repeat(0.05 * rng.standard_normal(1000), 20)
    turned = np.concatenate([[0.0], np.cumsum(speed) * fine])[::20]
    shown = np.diff(np.floor(turned / count)) * count / step
    found = estimate(Record("motor", step * np.arange(1000), levels, velocity=shown))
    delay = found.combinations["delay"]
    # 4 standard deviations: one in 16,000. The mean over a sample is 10 ms late.
    assert abs(delay.value - late) < 4 * delay.std
    assert delay.std < 0.01
