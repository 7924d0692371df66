"""What a model lacks is named, with a test of a stated size; clean data are left in peace."""

from __future__ import annotations

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.diagnosis import adequacy, beside, effect_regression, model_error
from smp_motor_ident.diagnosis.conditions import dependent
from smp_motor_ident.diagnosis.effects import EFFECTS
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.structures import StaticGain
from smp_motor_ident.record import Record
from smp_motor_ident.result import Quantity


def commanded(dead: float = 0.0, top: float = np.inf) -> Record:
    """A Fourier voltage of which the motor gets less than the record says."""
    t = np.arange(4000) / 200.0
    asked = motors.independent.excitation(t, "fourier", 10.0)
    given = np.sign(asked) * np.clip(np.abs(asked) - dead, 0.0, top)
    made = motors.record("rear_left", current=False, voltage=given, seconds=20.0)
    return replace(made, voltage=asked)


def test_clean_data_show_no_effect() -> None:
    codes = {effect.code for effect in EFFECTS}
    for wheel, seed in (("rear_left", 1), ("front_right", 2)):
        found = estimate(motors.record(wheel, current=False, seconds=8.0, seed=seed)).findings
        assert not codes & {f.code for f in found if f.severity == "unreliable"}


def test_a_clipped_command_is_found_out() -> None:
    found = estimate(commanded(top=6.0))
    clip = found.combinations["clip_voltage"]
    assert abs(clip.value - 6.0) < 4 * clip.std
    assert any(f.severity == "warning" and "record" in f.advice for f in found.findings)


@pytest.mark.parametrize("settles", [True, False])
def test_what_a_clipped_command_moves_is_in_the_intervals_or_unreliable(
    monkeypatch, settles: bool
) -> None:
    """Without its driver the motor is fitted beside effects that its error shows."""
    monkeypatch.setattr("smp_motor_ident.diagnosis.alternatives.likeliest", lambda *_: None)
    if not settles:
        monkeypatch.setattr(beside, "_fitted", lambda data, fit, options: fit)
    found = estimate(commanded(top=6.0))
    shown = [f for f in found.findings if f.evidence.get("shift_std") and f.severity != "note"]
    assert shown and all(f.evidence["quantity"] and f.advice for f in shown)
    assert {f.severity for f in shown} == ({"warning"} if settles else {"unreliable"})
    true = motors.truth("rear_left", 0.3)
    off = [abs(q.value - true[n]) / q.std for n, q in found.combinations.items() if q.value]
    assert max(off) < 3.0  # a move that is one standard deviation, and twice chance


def test_an_effect_whose_shape_the_model_has_to_a_twentieth_is_not_tried() -> None:
    rng = np.random.default_rng(3)
    own, noise, error = rng.standard_normal((3, 4000))
    block = np.arange(4000) * 40 // 4000
    tried = {}
    for part in (0.05, 0.5):  # what is left of the column, of its size
        table = np.column_stack([error, own, own + part * noise])
        members = [(EFFECTS[0], (0,))]
        tried[part] = model_error._projected(table, 1, block, members, 1).members
    assert not tried[0.05]  # a friction curve is not known to 5 %
    assert tried[0.5]


def test_a_load_that_is_nothing_is_no_number_that_an_effect_moves():
    def stated(name: str, value: float, std: float, row: float) -> adequacy.Stated:
        interval = (value - 2 * std, value + 2 * std)
        return name, Quantity(value, std, interval, "V"), np.array([row])

    def finding(shift: float) -> Finding:
        shown = adequacy.Evidence(EFFECTS[0], 1e-6, 200.0, np.array([shift]), (0,))
        numbers = [stated("static_voltage", 0.3, 3e-5, 0.0), stated("load_voltage", -1e-5, 3e-6, 1)]
        return adequacy.as_finding(shown, [shown], numbers, 0.005)

    # Twice its value, and a ten-thousandth of the friction; then a fifteenth of the friction.
    assert finding(2e-5).severity == "note"
    assert finding(0.02).severity == "unreliable"
    assert finding(0.02).evidence["quantity"] == "load_voltage"


def test_a_friction_that_is_nothing_is_moved_by_no_multiple_of_it():
    shown = adequacy.Evidence(EFFECTS[0], 1e-6, 200.0, np.array([2e-4]), (0,))
    numbers = [("static_voltage", Quantity(0.0, 1e-5, (0.0, 2e-5), "V"), np.array([1.0]))]
    assert adequacy.as_finding(shown, [shown], numbers, 0.005).severity == "note"  # 0.2 mV


def test_what_repeats_with_every_turn_is_asked_for_where_there_was_one():
    data = prepare([motors.record("rear_left", current=False, seconds=2.0)], False)
    signals = (data.time, data.voltage, np.ones(data.size), np.linspace(0.0, 7.0, data.size))
    turned = model_error._motion(data, 3.0, signals, 0.1, np.array([data.size]))
    once = {e.code: e for e in EFFECTS if e.code in ("position", "encoder_error")}
    assert [len(e.regressors(turned)) for e in once.values()] == [2, 2]  # not of the wheel
    still = replace(turned, angle=0.8 * turned.angle)  # 5.6 rad
    assert not any(e.regressors(still) for e in once.values())


def test_numbers_that_hang_on_the_size_of_the_voltage_cover_both_sizes():
    """A motor whose gain falls from 10 to 9 at the larger voltages, by regression alone."""
    rng = np.random.default_rng(4)
    volts = rng.choice([-1.0, 1.0], 4000) * rng.choice([2.0, 8.0], 4000)
    small = np.abs(volts) < 5.0
    fit = estimation_fit()
    for lost in (0.0, 1.0):
        speed = (10.0 - lost * ~small) * volts + 0.5 * rng.standard_normal(4000)
        gain = float(speed @ volts / (volts @ volts))
        errors = effect_regression.Regression(
            (speed - gain * volts) / 0.5, np.zeros((4000, 0)), np.zeros((4000, 0)),
            np.zeros((1, 0)), np.arange(4000) * 40 // 4000, [], volts[:, None] / 0.5, 1,
            {"size of the voltage": np.where(small, -1.0, 1.0)},
        )  # fmt: skip
        wider, said = dependent(fit, errors)
        assert bool(said) is bool(lost)
        if lost:  # the small voltages, nine times as heavy, ask for what they know of the gain
            assert 0.1 < float(np.sqrt(wider.added[0, 0])) < 1.0


def error_with(deviations: float, seed: int) -> effect_regression.Regression:
    """White errors that show an effect by so many deviations; a unit of it moves a number by 1."""
    rng = np.random.default_rng(seed)
    shape, error = rng.standard_normal((2, 4000))
    shape /= np.linalg.norm(shape)
    if deviations:
        error += (deviations - shape @ error) * shape
    return effect_regression.Regression(
        error, shape[:, None], shape[:, None], np.ones((1, 1)), np.arange(4000) * 40 // 4000,
        [(EFFECTS[0], (0,))], np.zeros((4000, 0)), 1,
    )  # fmt: skip


def held_against(deviations: float, value: float = 30.0, seed: int = 5):
    numbers = [("dc_gain", Quantity(value, 0.3, (0.0, 2 * value), "rad/(V s)"), np.ones(1))]
    return found_of(error_with(deviations, seed), numbers)


def found_of(errors: effect_regression.Regression, numbers: list[adequacy.Stated]):
    """Return the findings of white errors, and the move that is neither shown nor excluded."""
    shown, possible = adequacy.lacking(errors, white=True)
    notes, move = adequacy.farthest_possible(possible, numbers, 0.005)
    return [*(adequacy.as_finding(e[0], e, numbers, 0.005) for e in shown), *notes], move


def test_an_effect_that_is_neither_shown_nor_excluded_is_in_the_intervals():
    # The probability of 2.3 deviations by chance is 2 %: between a finding's 0.1 % and an
    # interval's 5 %; of 1 it is 32 %, of 4 it is 6e-5.
    (found,), moved = held_against(2.3)
    assert found.severity == "note" and found.evidence["quantity"] == "dc_gain"
    np.testing.assert_allclose(moved, 2.3, rtol=1e-9)
    assert held_against(1.0) == ([], None)
    (sure,), nothing = held_against(4.0)
    assert sure.severity == "unreliable" and nothing is None
    assert held_against(2.3, value=300.0) == ([], None)  # less than a hundredth of the number


def test_intervals_of_clean_errors_are_widened_as_seldom_as_stated():
    widened = sum(held_against(0.0, seed=seed)[1] is not None for seed in range(400))
    # 4.9 % of them lie between the two levels: 20, four binomial deviations above them.
    assert widened <= 20 + 4 * 4.3


def estimation_fit() -> Fit:
    """A fit of one free coordinate, of which only that matters here."""
    structure = StaticGain(friction="none")
    return Fit(
        np.zeros(12), np.zeros((1, 5)), np.eye(2), structure=structure, gain=np.zeros((3, 2)),
        objective=1.0, deviance=0.0, information=np.eye(1), scores=np.zeros((0, 1)), passes=1,
        converged=True, samples=4000, kind=0,
    )  # fmt: skip


def test_an_effect_whose_rows_hold_no_error_is_not_tried_and_nothing_breaks():
    """A sensor without noise leaves no error at rest, where alone coasting would show."""
    shape = np.where(np.arange(4000) < 400, 1e-32, 0.0)[:, None]
    errors = replace(
        error_with(0.0, 5),
        residual=np.where(shape[:, 0] > 0, 0.0, error_with(0.0, 5).residual),
        regressors=shape,
        whole=shape,
    )
    numbers = [("dc_gain", Quantity(30.0, 0.3, (0.0, 60.0), "rad/(V s)"), np.ones(1))]
    assert found_of(errors, numbers) == ([], None)


def test_a_motor_at_rest_turns_by_no_rounding_error():
    record = motors.record("rear_left", current=False, seconds=2.0)
    data, size = prepare([record], False), len(record)
    speed = np.where(np.arange(size) < size // 2, 1e-28, 30.0)
    signals = (data.time, record.voltage, speed, np.zeros(size))
    motion = model_error._motion(data, 1.0, signals, 0.1, np.array([size]))
    assert not motion.speed[: size // 2].any() and motion.speed[-1] == motion.fastest == 30.0


def test_what_any_effect_that_is_shown_would_move_is_in_the_intervals(monkeypatch) -> None:
    """Fitted beside the likeliest of them a motor may stay where it is; the others are as real."""
    monkeypatch.setattr("smp_motor_ident.diagnosis.alternatives.likeliest", lambda *_: None)
    monkeypatch.setattr(beside, "_move", lambda _, fit, *__: np.zeros(len(fit.structure.free)))
    found = estimate(commanded(top=6.0))
    shown = [f for f in found.findings if f.evidence.get("shift_std", 0.0) > 2]
    assert shown
    for finding in shown:
        quantity = found.combinations[finding.evidence["quantity"]]
        assert quantity.std > 0.99 * finding.evidence["shift_share"] * abs(quantity.value)


def test_an_effect_is_held_against_the_intervals_that_are_stated(monkeypatch) -> None:
    """What moves a number beyond the likelihood's interval may be within that of the answer."""
    record = commanded(top=6.0)
    monkeypatch.setattr("smp_motor_ident.diagnosis.alternatives.likeliest", lambda *_: None)
    monkeypatch.setattr(beside, "_move", lambda *_: None)

    def unreliable() -> set[str]:
        found = [f for f in estimate(record).findings if f.evidence.get("shift_std", 0) > 2]
        return {f.code for f in found if f.severity == "unreliable"}

    def late(data, fit):
        wide = fit.wider(np.diag(np.square(np.full(len(fit.structure.free), 0.15))))
        return wide, [Finding("command_jitter", "note", "it is late")]

    narrow = unreliable()
    monkeypatch.setattr("smp_motor_ident.diagnosis.misfit.jittered", late)
    assert narrow and not unreliable()


def test_an_effect_counts_in_no_unit():
    # The squares of squares of the smallest responses are no floating-point numbers.
    errors = error_with(4.0, 5)
    small = replace(errors, regressors=1e-100 * errors.regressors, whole=1e-100 * errors.whole)
    usual, tiny = (adequacy._test(e, EFFECTS[0], (0,), False) for e in (errors, small))
    assert tiny.p_value == pytest.approx(usual.p_value, rel=1e-6)


@pytest.mark.parametrize(
    ("kept", "deviations", "size"),
    [(0.001, 0.0, 0.01), (1000.0, 0.0, 0.001), (1000.0, 30.0, 0.01)],
)
def test_what_hides_in_the_motors_own_numbers_is_no_larger_than_ordinary(kept, deviations, size):
    """A unit of it moves a number by one; what is left of its response is so long."""
    errors = error_with(deviations, 5)
    hides = replace(
        errors, members=[], regressors=kept * errors.regressors, hidden=[(EFFECTS[0], 0, 0.01)]
    )
    (found,) = adequacy.hidden(hides)
    # Nobody knows; or data tell to a thousandth; or another effect explains what is like it.
    assert size / 3 < found.shift[0] <= 1.5 * size


def test_a_drag_between_two_levels_is_in_the_interval_of_the_gain():
    rate, rng = 200, np.random.default_rng(8)
    voltage = np.repeat(np.tile([5.0, 9.0], 8), 200)
    gain, tau, friction, drag = 12.0, 0.03, 0.6, 2e-5  # 0.2 V at the highest speed
    w, speed = 0.0, []
    for v in voltage.tolist():
        for _ in range(20):
            ahead = gain * (v - friction - drag * w * w) - w
            w = max(w + ahead / tau / rate / 20, 0.0)
        speed.append(w)
    time = np.arange(voltage.size) / rate
    found = estimate(
        Record("motor", time, voltage, velocity=np.array(speed) + rng.standard_normal(time.size))
    )
    known = found.combinations["dc_gain"]
    assert abs(known.value - gain) < 5 * known.std  # 3.5 % off
