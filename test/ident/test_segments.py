"""A motor that changes within a record gets the intervals of the next recording, others do not."""

from dataclasses import replace

import independent
import motors
import numpy as np
import pytest

from smp_motor_ident.diagnosis import refusal
from smp_motor_ident.diagnosis.adequacy import lacking
from smp_motor_ident.diagnosis.model_error import regression
from smp_motor_ident.errors import SignalError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation import segments
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.segments import heterogeneous
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.likelihood.first_order_lag import lagged
from smp_motor_ident.model.structures import FirstOrder
from smp_motor_ident.record import Record


def _first_order(gain, tau, friction, seed, seconds=40.0, rate=100.0):
    """Return a record of tau w' = gain (v - friction) - w, gain and friction given per sample."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate)
    t = np.arange(n) / rate
    v = np.repeat(rng.choice([3.0, 5.0, 8.0], n // 20), 20)[:n]
    w = np.zeros(n)
    keep = np.exp(-1 / rate / tau)
    gain, friction = np.broadcast_to(gain, n), np.broadcast_to(friction, n)
    for k in range(1, n):
        w[k] = keep * w[k - 1] + (1 - keep) * gain[k] * max(v[k] - friction[k], 0.0)
    return Record("motor", t, v, velocity=w + 0.2 * rng.standard_normal(n))


def _changes(record):
    return [f for f in estimate(record, "first_order").findings if f.code == "motor_changes"]


def test_a_motor_that_warms_up_is_said_to_and_its_interval_reaches_the_next_day():
    n = 4000
    warm = np.linspace(10.0, 10.4, n)  # 4 % in 40 s
    found = estimate(_first_order(warm, 0.08, np.linspace(0.6, 0.5, n), 1), "first_order")
    assert [f for f in found.findings if f.code == "motor_changes"]
    # Its mean is 10.2; the next record begins where this one ended.
    gain = found.combinations["dc_gain"]
    assert gain.ci95[0] < 10.0 and gain.ci95[1] > 10.4
    assert gain.std < 0.6  # three quarters more than the drift: Student's t and its noise


def test_the_interval_of_a_motor_that_changes_holds_another_days_friction():
    drifts = _first_order(np.linspace(10.0, 10.2, 4000), 0.08, 0.6, 1)
    low, high = estimate(drifts, "first_order").combinations["static_voltage"].ci95
    # 5 K: half of friction the lubricant's (3.7 % a kelvin), volts by copper and magnets.
    for kelvin in (-5, 5):
        assert low < 0.6 * (1 + kelvin * (0.0039 + 0.002 - 0.037 / 2)) < high


def test_a_motor_that_does_not_change_is_rarely_said_to():
    # One in a hundred by the test's size: two of eight has a chance of 0.3 %.
    assert sum(bool(_changes(_first_order(10.0, 0.08, 0.6, s))) for s in range(8)) < 2


def test_parts_without_excitation_do_not_count():
    still = motors.record("rear_left", current=False, seconds=4.0)
    found = estimate(still)
    truth = motors.truth("rear_left", 0.3)
    for name in ("dc_gain", "time_constant"):
        q = found.combinations[name]
        assert abs(q.value - truth[name]) < 4 * q.std, name
        assert q.std < 0.02 * truth[name], name  # the bound is 0.1 %


def test_many_short_segments_at_rest_before_the_motion_hide_no_motor():
    # A computer that stood still while a robot waited: each gap begins a segment.
    n, rate = 1000, 200.0
    t = np.arange(n) / rate
    moving = [independent.excitation(t, kind, 10.0) for kind in ("square", "fourier")]
    volts = np.concatenate([np.zeros(240), *moving])
    whole = motors.record("rear_left", voltage=volts, kinds=("square",) * 3)
    found = estimate(replace(whole, starts=tuple(range(0, 240, 20))))
    truth = motors.truth("rear_left", 0.3)
    for name in ("dc_gain", "time_constant"):
        q = found.combinations[name]
        assert abs(q.value - truth[name]) < 4 * q.std, name


def test_a_segment_that_begins_in_a_reversal_does_not_begin_with_a_wheel_held_by_friction():
    # Through zero speed a coarse encoder shows the same count twice, and the wheel is not at rest.
    fine = motors.record("rear_left", seconds=6.0, kinds=("square", "fourier"))
    coarse = fine.count // 10
    hardware = replace(fine.hardware, counts_per_revolution=50.0)
    record = replace(fine, count=coarse, velocity=None, hardware=hardware)
    k = next(
        k for k in range(200, 1000)
        if coarse[k] == coarse[k + 1] and abs(coarse[k + 4] - coarse[k]) > 1
        and abs(coarse[k] - coarse[k - 4]) > 1
    )  # fmt: skip
    found = estimate(record.slice(k, len(coarse)))
    gain, true = found.combinations["dc_gain"], motors.truth("rear_left", 0.3)["dc_gain"]
    assert not [f for f in found.findings if f.code in ("torque_noise", "not_converged")]
    assert abs(gain.value - true) < 4 * gain.std
    assert gain.std < 1e-3 * true  # 11 s of motion; a torque that fluctuates made it 8e-3


def test_what_a_part_knows_but_for_rounding_is_a_covariance():
    # Two coordinates of which the sum alone is known, to 1 part in 10^8, and rounding.
    rng = np.random.default_rng(1)
    for _ in range(20):
        information = 1e16 * np.ones((2, 2)) + np.diag(rng.uniform(-4.0, 4.0, 2))
        covariance = segments._bounded_inverse(information)
        assert np.linalg.eigvalsh(covariance)[0] > 0
        np.testing.assert_allclose(np.ones(2) @ information @ covariance, np.ones(2), rtol=1e-3)


def test_a_part_tells_nothing_of_what_its_beginning_takes_all_of():
    rng = np.random.default_rng(2)
    own = rng.standard_normal((400, 2))
    free = rng.standard_normal((400, 3))
    free[:, 1] = own @ [0.7, -1.3]
    both, error = np.hstack([free, own]), rng.standard_normal(400)
    left, score = segments._without_beginning(both.T @ both, both.T @ error, 3)
    projected = free - own @ np.linalg.lstsq(own, free, rcond=None)[0]
    assert not left[1].any() and not left[:, 1].any() and score[1] == 0.0
    assert left[::2, ::2] == pytest.approx((projected.T @ projected)[::2, ::2])
    assert score[::2] == pytest.approx((projected.T @ error)[::2])


def _runs(gains, named=True):
    """Return records of a motor whose gain is another in each; of 8 s, of two levels and rest."""
    runs = [_first_order(g, 0.08, 0.6, 20 + n, seconds=8.0) for n, g in enumerate(gains)]
    return [replace(r, source=f"run{n}") if named else r for n, r in enumerate(runs)]


def test_the_record_that_alone_differs_is_named():
    found = estimate(_runs([10.0, 10.0, 7.5, 10.0]), "first_order")
    (change,) = [f for f in found.findings if f.code == "motor_changes"]
    assert change.severity == "warning" and change.evidence["record"] == "run2"
    assert "dc_gain -2" in change.message
    gain = found.combinations["dc_gain"]
    assert gain.ci95[0] < 7.5 and gain.ci95[1] > 10.0


def test_records_that_all_differ_are_of_one_changing_motor():
    found = estimate(_runs([10.0, 9.2, 10.8, 9.6, 10.5]), "first_order")
    (change,) = [f for f in found.findings if f.code == "motor_changes"]
    assert change.severity == "note"
    gain = found.combinations["dc_gain"]
    spread = np.std([10.0, 9.2, 10.8, 9.6, 10.5], ddof=1)
    # Of another recording, by Student's t of four degrees of freedom, and the mean's own.
    assert 0.9 * spread < gain.std < 2.0 * spread


def test_two_records_of_different_motors_are_said_to_differ():
    found = estimate(_runs([10.0, 8.0]), "first_order")
    assert [f for f in found.findings if f.code == "motor_changes"]


def test_records_of_one_motor_are_rarely_said_to_differ():
    groups = ([_first_order(10.0, 0.08, 0.6, 100 + 4 * k + j, 8.0) for j in range(4)]
              for k in range(8))  # fmt: skip
    assert sum(bool(_changes(g)) for g in groups) < 2


def test_the_record_of_swapped_sign_is_named_among_others():
    records = _runs([10.0] * 4)
    records[1] = replace(records[1], velocity=-records[1].velocity)
    with pytest.raises(SignalError, match="run1: motor: swapped sign"):
        estimate(records, "first_order")


def test_a_refusal_of_several_names_those_that_are_refused_alone():
    records = _runs([10.0] * 3)
    together = SignalError("run0, run1, run2: motor: no")

    def alone(record):
        if record.source == "run1":
            raise SignalError("run1: motor: a reason")

    said = str(refusal.of_which(records, together, alone))
    assert said.endswith("the others are explained without run1; alone: run1: motor: a reason")
    assert "not of one motor" in str(refusal.of_which(records, together, lambda _: None))
    own = SignalError("run1: motor: of one record")
    assert refusal.of_which(records, own, alone) is own


def _one_step(gain, tau, friction, seed):
    """Return a step to 10 V from rest, of which gain and friction are known only together."""
    t = np.arange(300) / 100.0
    speed = gain * (10.0 - friction) * -np.expm1(-np.maximum(t - 0.3, 0.0) / tau)
    noise = 0.02 * gain * np.random.default_rng(seed).standard_normal(t.size)
    return Record("motor", t, np.where(t < 0.3, 0.0, 10.0), velocity=speed + noise)


@pytest.mark.parametrize("seed", [1, 4])
def test_repeats_of_a_step_whose_friction_changes_scatter_no_more_than_their_interval(seed):
    """Gain and friction are known along a ridge: a change of one is judged with the other held."""
    rng = np.random.default_rng(seed)
    gain, tau = rng.uniform(5, 30), rng.uniform(0.1, 0.4)
    frictions = 8.0 + 0.1 * rng.standard_normal(8)
    repeats = [_one_step(gain, tau, f, n) for n, f in enumerate(frictions)]
    found = estimate(repeats, "first_order")
    assert any(f.code == "motor_changes" for f in found.findings)
    steady, scatter = found.combinations["steady_speed"], gain * frictions.std(ddof=1)
    # The next one's: the scatter, by Student's t of seven degrees of freedom over the normal's.
    assert scatter < steady.std < 1.5 * scatter
    same = [_one_step(gain, tau, 8.0, n) for n in range(8)]
    assert not any(f.code == "motor_changes" for f in estimate(same, "first_order").findings)


def test_what_differs_from_day_to_day_is_no_effect_of_the_voltages_that_they_had() -> None:
    rng = np.random.default_rng(0)
    days = []
    for top in (3.0, 4.5, 6.0, 7.5, 9.0):
        gain, friction = 2.8 * (1 + 0.02 * rng.standard_normal()), rng.normal(0.22, 0.06)
        v, noise = np.repeat(rng.choice([0.3, 1.0], 150), 10) * top, rng.standard_normal(1500)
        w = lagged(gain * np.maximum(v - friction, 0.0), 2.0) + 0.02 * gain * top * noise
        days.append(Record("motor", 0.02 * np.arange(1500), v, velocity=w))
    data = prepare(days, False)
    fit = initial_fit(data, FirstOrder(), Options())
    assert fit is not None
    fit, change = heterogeneous(data, fit)
    assert change.std
    alike, apart = (regression(data, fit, 1.0, changing) for changing in (False, True))
    assert lacking(alike, True)[0] and not lacking(apart, True)[0]


@pytest.mark.parametrize("seed", [4, 30])
def test_a_speed_of_whole_counts_a_sample_is_no_change_of_the_motor(seed: int) -> None:
    """What a counter rounds away is the same for as long as such a speed lasts."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform(2, 9, 14) * rng.choice([-1, 1], 14)
    volts = np.repeat(levels, rng.integers(150, 600, 14))[:5000]
    whole = motors.record("rear_left", voltage=volts, rate=2000.0, current=False)
    found, truth = estimate(replace(whole, velocity=None)), motors.truth("rear_left", 0.3)
    assert "motor_changes" not in {f.code for f in found.findings}
    for name in ("dc_gain", "time_constant"):
        q = found.combinations[name]
        assert abs(q.value - truth[name]) < 4 * q.std < 0.01 * q.value, name
