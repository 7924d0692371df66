"""When the data reject a simpler structure: the rule on numbers of the test's own."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import motors
import numpy as np
import pytest
from independent import simulate

from smp_motor_ident.diagnosis.advice import unsettled_rival
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation import variations
from smp_motor_ident.estimation.descent import bandwidth, noise_ratio_of
from smp_motor_ident.estimation.fit import Options, solve
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.quantities import answer
from smp_motor_ident.estimation.selection import FittedCandidate, SelectionPolicy, sandwich_factor
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.coordinates import NAMES, Coordinates
from smp_motor_ident.model.structures import Electromechanical, FirstOrder, SecondOrder, Structure
from smp_motor_ident.record import Hardware, Record

POLICY = SelectionPolicy()
FIRST = FirstOrder()
SECOND = SecondOrder()
SAMPLES = 2981  # whose logarithm is 8.0001
PRICE = math.log(SAMPLES) + 4.0
"""Of one parameter: ln(n) as in the BIC, and prior odds of e^2 to 1 against it."""


def fit(structure: Structure, deviance: float, *, factors=(1.0,), std: float = 0.01, **more: Any):
    """A fit as the rule sees it, all of its coordinates 1 and known to ``std``."""
    covariance = std**2 * np.eye(len(structure.free))
    return SimpleNamespace(
        structure=structure, deviance=deviance, samples=SAMPLES,
        z=Coordinates.of(np.ones(len(NAMES))),
        sandwich_factors=lambda: np.array(factors), covariance=lambda: covariance,
        **{"converged": True, **more},
    )  # fmt: skip


@pytest.mark.parametrize(("gain", "richer"), [(PRICE - 0.01, False), (PRICE + 0.01, True)])
def test_one_more_parameter_is_worth_its_price(gain: float, richer: bool) -> None:
    chosen, reason = POLICY.needed(fit(FIRST, 100.0), fit(SECOND, 100.0 - gain))
    assert chosen is richer
    assert reason.startswith("first_order" if richer else "no better than first_order")
    assert reason.endswith("(gain 12, price 12)")


@pytest.mark.parametrize(("gain", "lag"), [(19.9, True), (20.1, False)])
def test_a_lag_is_believed_up_to_odds_of_e_to_the_ten_whichever_came_first(gain, lag) -> None:
    second, late = fit(SECOND, 0.0), fit(FirstOrder(delay=True), -gain)
    assert POLICY.preferred(late, second)[0] is lag
    assert POLICY.preferred(second, late)[0] is not lag


@pytest.mark.parametrize(("gain", "richer"), [(2 * PRICE - 0.01, False), (2 * PRICE + 0.01, True)])
def test_two_more_parameters_are_worth_twice_that(gain: float, richer: bool) -> None:
    rich = SecondOrder(delay=True)
    assert POLICY.needed(fit(FIRST, 0.0), fit(rich, -gain))[0] is richer


def test_residuals_that_are_not_white_are_believed_by_so_much_less() -> None:
    # The largest of the factors divides the gain: 2 of 1, 2.
    for gain, richer in ((2 * PRICE - 0.01, False), (2 * PRICE + 0.01, True)):
        assert POLICY.needed(fit(FIRST, 0.0), fit(SECOND, -gain, factors=(1.0, 2.0)))[0] is richer
    assert sandwich_factor(fit(FIRST, 0.0, factors=(0.2, 0.4, 9.0))) == 1.0
    assert sandwich_factor(fit(FIRST, 0.0, factors=(2.0, 3.0, 9.0))) == 3.0


@pytest.mark.parametrize(
    ("structure", "word"),
    [(SECOND, "second time constant"), (FirstOrder(delay=True), "delay"),
     (FirstOrder(window=True), "window")],
)  # fmt: skip
def test_what_is_not_known_to_two_fifths_must_be_worth_three_times_the_price(structure, word):
    for std, gain, richer in ((0.41, 3 * PRICE - 0.1, False), (0.41, 3 * PRICE + 0.1, True),
                              (0.39, PRICE + 0.1, True)):  # fmt: skip
        chosen, reason = POLICY.needed(fit(FIRST, 0.0), fit(structure, -gain, std=std))
        assert chosen is richer
        assert (f"its {word} is not identifiable" in reason) is not richer
    load = FirstOrder(load=True)
    assert POLICY.needed(fit(FIRST, 0.0), fit(load, -PRICE - 0.1, std=9.0))[0] is True


def test_what_did_not_converge_must_be_worth_three_times_the_price() -> None:
    for gain, richer in ((3 * PRICE - 0.1, False), (3 * PRICE + 0.1, True)):
        chosen, reason = POLICY.needed(fit(FIRST, 0.0), fit(SECOND, -gain, converged=False))
        assert chosen is richer and ("did not converge" in reason) is not richer


def test_a_shape_that_friction_alone_tells_is_not_charged_for() -> None:
    shaped = SecondOrder(shape=True)
    assert shaped.size == SECOND.size == len(SECOND.free)
    assert Electromechanical().size == len(SECOND.free) + 2  # R, te
    candidate = FittedCandidate(fit(shaped, 50.0))  # type: ignore[arg-type]
    assert candidate.bic == pytest.approx(50.0 + len(SECOND.free) * math.log(SAMPLES))
    assert candidate.label == "second_order"


def test_a_structure_is_named_with_all_that_was_added() -> None:
    assert SecondOrder("none", load=True).label == "second_order with no friction, load"
    rest = Electromechanical("asymmetric", delay=True, window=True, offset=True)
    words = "asymmetric friction, delay, averaged speed, current offset"
    assert rest.label == f"electromechanical with {words}"


def test_torque_noise_does_not_hide_a_delay(monkeypatch):
    """With torque noise the score says nothing of a delay: a fit that begins without it does."""
    prompt = motors.record("rear_left", seconds=2.0)
    late = dataclasses.replace(prompt, voltage=np.append(prompt.voltage[1:], 0.0))
    data = prepare([late], True)
    plain = initial_fit(data, Electromechanical(), Options())
    ratio = noise_ratio_of(bandwidth(plain.z, data), data.step, data.kind)
    noisy = solve(data, plain.structure, plain.at(plain.z, noise_ratio=ratio), Options(), 20)
    monkeypatch.setattr(SelectionPolicy, "worth_a_fit", lambda *_: False)
    best = variations.varied(data, noisy, Options(), [], lambda _: None)
    assert best.structure.delay
    assert best.z.delay == pytest.approx(data.step, rel=0.05)


def test_a_better_structure_that_did_not_settle_makes_the_answer_unreliable() -> None:
    data = prepare([motors.record("rear_left", seconds=2.0, current=False)], False)
    poor, rich = (initial_fit(data, s, Options()) for s in (FIRST, SECOND))
    result = answer(poor, {})
    unsettled = dataclasses.replace(rich, converged=False)
    (found,) = unsettled_rival([FittedCandidate(unsettled), FittedCandidate(poor)], result, {})
    assert found.severity == "unreliable" and "time_constant" in found.message
    # Not where it settled, where it is no better, or where its values are those that are stated.
    assert not unsettled_rival([FittedCandidate(rich), FittedCandidate(poor)], result, {})
    worse = dataclasses.replace(unsettled, deviance=poor.deviance)
    assert not unsettled_rival([FittedCandidate(worse), FittedCandidate(poor)], result, {})
    # Nor is a second lag one that is believed over a delay although it fits worse.
    late = initial_fit(data, FIRST.with_(delay=True), Options())
    behind = dataclasses.replace(unsettled, deviance=late.deviance + 10.0)
    assert POLICY.preferred(late, dataclasses.replace(behind, converged=True))[0]
    assert not POLICY.preferred_but_for_descent(FittedCandidate(late), FittedCandidate(behind))
    own = answer(rich, {})
    better = FittedCandidate(dataclasses.replace(unsettled, deviance=rich.deviance - 1e4))
    assert not unsettled_rival([better, FittedCandidate(rich)], own, {})


def _loaded(seed: int) -> tuple[Record, dict[str, float]]:
    """Return counts of a random motor with a constant load, on a staircase either way."""
    rng = np.random.default_rng(seed)
    tau, r, k = rng.uniform(0.2, 0.4), rng.uniform(1, 6), rng.uniform(0.01, 0.06)
    j, el, b = tau * k * k / r, r * tau * rng.uniform(0.02, 0.05), 0.1 * k * k / r
    friction = rng.uniform(0.3, 0.6)
    load = rng.uniform(0.1, 0.3) * friction
    t = np.arange(2000) / 100.0
    v = np.repeat(np.concatenate([np.linspace(1, 6, 10), np.linspace(-1, -6, 10)]), 100)
    torque = np.full(t.size, load * k / r)
    out = simulate(t, v, r, el, k, j, b, friction * k / r, torque, 200)
    count = np.floor(out[:, 2] * 500 / (2 * np.pi) + rng.uniform()).astype(np.int64)
    stiff = r * b + k * k
    true = {
        "dc_gain": k / stiff, "time_constant": (r * j + el * b) / stiff,
        "time_constant_product": el * j / stiff, "static_voltage": friction, "load_voltage": load,
    }  # fmt: skip
    return Record("m", t, v, count=count, hardware=Hardware(1.0, 500.0, 0, 12.0)), true


@pytest.mark.parametrize("seed", range(6))
def test_a_constant_load_is_no_torque_noise(seed: int) -> None:
    # A second lag and a load each look like torque noise while the other is missing.
    record, true = _loaded(seed)
    found = estimate(record)
    assert found.model == "second_order"
    assert "torque_noise" not in [f.code for f in found.findings]
    for name, value in true.items():
        q = found.combinations[name]
        assert abs(q.value - value) < 4 * q.std, name
    assert found.combinations["time_constant"].std < 0.01 * true["time_constant"]


def test_a_second_lag_is_found_under_a_load_that_hid_it() -> None:
    # Without the load no order fits; with it, a delay had taken the second lag's place.
    rng = np.random.default_rng(6)
    r, k, tau, te, friction, load = 3.0, 0.02, 0.055, 0.01, 0.9, -0.35
    j, el, b = tau * k * k / r, r * te, 0.1 * k * k / r
    t = np.arange(2000) / 200.0
    v = 9.6 * np.sin(2 * np.pi * 2.5 * t)
    torque = np.full(t.size, load * k / r)
    out = simulate(t, v, r, el, k, j, b, friction * k / r, torque, 100)
    speed = out[:, 1] + 0.01 * np.abs(out[:, 1]).max() * rng.standard_normal(t.size)
    found = estimate(Record("m", t, v, velocity=speed))
    assert found.model == "second_order" and not found.unreliable
    stiff = r * b + k * k
    true = {"dc_gain": k / stiff, "time_constant": (r * j + el * b) / stiff, "load_voltage": load}
    for name, value in true.items():
        q = found.combinations[name]
        assert abs(q.value - value) < 4 * q.std, name


@pytest.mark.parametrize("seed", range(4))
def test_a_constant_load_hides_no_resistance(seed: int) -> None:
    # R and K that were fitted without the load are no start for a fit with it.
    rng = np.random.default_rng(seed)
    r, k, tau, friction, load = 14.7, 0.047, 0.026, 1.9, rng.choice([-1, 1]) * rng.uniform(0.3, 0.6)
    j, el, b = tau * k * k / r, r * 7e-4, 0.1 * k * k / r
    t = np.arange(900) / 100.0
    v = 18.0 * rng.choice([-1.0, 1.0], t.size)
    out = simulate(t, v, r, el, k, j, b, friction * k / r, np.full(t.size, load * k / r), 200)
    count = np.floor(out[:, 2] * 64 / (2 * np.pi) + rng.uniform()).astype(np.int64)
    current = out[:, 0] + 0.012 * rng.standard_normal(t.size)
    hardware = Hardware(1.0, 64.0, 0, 24.0)
    found = estimate(Record("m", t, v, current, count=count, hardware=hardware))
    assert not found.unreliable
    true = {"resistance": r, "motor_constant": k, "inertia": j, "load_voltage": load}
    for name, value in true.items():
        q = {**found.parameters, **found.combinations}[name]
        assert q.value is not None and abs(q.value - value) < 4 * q.std, name
        assert q.std < 0.02 * abs(value), name


def _staircase(r, el, k, j, b, tc, top, rate, n, weaker=0.0):
    """Return times, voltages, speeds and angles of a motor that a staircase of 20 steps drives."""
    levels = np.concatenate([np.linspace(0, 1, 7), np.linspace(1, -1, 13)])
    t, volts = np.arange(n) / rate, top * np.repeat(levels, n // 20 + 1)[:n]
    given = np.where(volts < 0, (1 - weaker) * volts, volts)
    out = simulate(t, given, r, el, k, j, b, tc, np.zeros(n), 10)
    return t, volts, out[:, 1], out[:, 2]


def test_friction_is_not_taken_for_torque_noise():
    """A staircase of an angle known to a milliradian, of which friction takes an eighth."""
    r, k, b, tc = 6.65, 0.0319, 3.27e-5, 6.83e-3
    t, volts, _, angle = _staircase(r, 0.058, k, 2.5e-5, b, tc, 11.9, 1000.0, 8738)
    noise = 0.3 * 2 * np.pi / 2000 * np.random.default_rng(0).standard_normal(t.size)
    found = estimate(Record("motor", t, volts, position=angle + noise))
    assert not found.unreliable
    # The test's own integration is good to a ten thousandth.
    assert found.value("static_voltage") == pytest.approx(r * tc / k, rel=1e-3)
    assert found.value("dc_gain") == pytest.approx(1 / (k + r * b / k), rel=1e-3)


def test_no_structure_is_rejected_for_the_torque_noise_that_another_began_with():
    """The same staircase by a driver that is a hundredth weaker in reverse, which looks like
    torque noise: the bandwidth of a wrong motor, which follows whatever comes, asks for more."""
    r, k, b, tc = 6.65, 0.0319, 3.27e-5, 6.83e-3
    t, volts, _, angle = _staircase(r, 0.058, k, 2.5e-5, b, tc, 11.9, 1000.0, 8738, weaker=0.01)
    noise = 0.3 * 2 * np.pi / 2000 * np.random.default_rng(0).standard_normal(t.size)
    found = estimate(Record("motor", t, volts, position=angle + noise))
    # Twice the hundredth by which the motor is none.
    assert found.value("static_voltage") == pytest.approx(r * tc / k, rel=2e-2)
    assert found.value("dc_gain") == pytest.approx(1 / (k + r * b / k), rel=2e-2)
    assert found.value("time_constant") == pytest.approx(0.1362, rel=2e-2)


def test_friction_is_asked_for_where_a_linear_motor_leaves_coloured_residuals():
    """A staircase whose score of no friction tells nothing: friction takes a quarter of it."""
    r, k, b, tc = 3.24, 0.0183, 2.13e-5, 8.8e-3
    t, volts, speed, _ = _staircase(r, 1.7e-3, k, 3.83e-6, b, tc, 6.0, 5000.0, 15000)
    noise = 0.8 * np.random.default_rng(0).standard_normal(t.size)
    found = estimate(Record("motor", t, volts, velocity=speed + noise))
    assert not found.unreliable
    assert found.value("static_voltage") == pytest.approx(r * tc / k, rel=1e-3)
    assert found.value("dc_gain") == pytest.approx(1 / (k + r * b / k), rel=1e-3)
