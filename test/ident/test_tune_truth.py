# SPDX-License-Identifier: Apache-2.0
"""Gains keep their margins on the identified drive, with its sensor, friction and uncertainty."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from drives import LOOP, TRUE, change, estimate, overshoot

from smp_motor_ident.cli.tune import main as tune
from smp_motor_ident.errors import DesignError
from smp_motor_ident.finding import Finding
from smp_motor_ident.report.document import identification_document
from smp_motor_ident.result import ChainRecord, Estimate, Quantity, Share, Systematic
from smp_motor_ident.tune import design
from smp_motor_ident.tune.feedback import Feedback, batch_margins, loop_margins, spectral_radius
from smp_motor_ident.tune.motors import bound_friction, make_motors
from smp_motor_ident.tune.plant import sample
from smp_motor_ident.tune.problem import Problem

DOUBT = Finding("dead_zone", "unreliable", "a dead zone of 2 V", {}, "record slow ramps")


@pytest.mark.parametrize(
    ("sensor", "name"), [({"window": 0.05}, "averaging_window"), ({"lag": 0.04}, "sensor_lag")]
)
def test_design_accounts_for_the_speed_filter_of_the_firmware(sensor, name):
    value = next(iter(sensor.values()))
    aware, ignorant = design(estimate(**{name: value}), LOOP), design(estimate(), LOOP)
    # 0.25 %: error of the integration in steps of T/50.
    assert overshoot(aware, TRUE, **sensor) <= aware.specification.overshoot.high + 0.25
    assert overshoot(aware, TRUE, **sensor) < 2.0
    assert overshoot(ignorant, TRUE, **sensor) > 3.0
    assert aware.reference.lag == pytest.approx(
        0.01 + (value / 2 if name == "averaging_window" else value)
    )


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_lag_possibly_of_the_sensor_causes_no_overshoot(share):
    """The motor leads its filtered speed: feed-forward for the whole lag overshoots."""
    doubt = Share("low_passed_speed", 0.3, 0.045)
    lags = {"time_constant": 0.15, "time_constant_product": 0.1 * 0.05}
    filtered = {**TRUE, "time_constant": 0.1, "time_constant_product": 1e-4}
    known = estimate(**lags)
    lag = replace(known.combinations["time_constant"], systematic=(doubt,))
    aware = replace(known, combinations={**known.combinations, "time_constant": lag})
    aware = design(aware, LOOP)
    ignorant = design(estimate(**lags), LOOP)
    stated = ignorant.specification.overshoot.high
    assert overshoot(ignorant, filtered, lag=0.05, share=share) > stated + 5.0
    for motor, lag in ((filtered, 0.05), ({**TRUE, **lags}, 0.0)):
        over = overshoot(aware, motor, lag=lag, share=share)
        assert over <= aware.specification.overshoot.high + 0.25
        assert over < 4.0
    assert any("filter" in words for words in aware.warnings)


def test_reference_changes_stay_within_the_driver_slew_rate():
    """A slew-limited driver follows the feed-forward of every change without lag."""
    slewed = ChainRecord(("slew",), {"ramp_time": 12.0 / 40.0})
    one = design(replace(estimate(), chain=slewed, largest_voltage=12.0), LOOP)
    plan, gains, T = one.reference, one.gains, LOOP.sample_time
    for begin, end in ((0.0, 0.5), (0.0, 0.05), (1.0, -1.0), (-0.9, -0.2)):
        profile = plan.profile()
        profile.reset(begin * plan.max_velocity)
        profile.set_target(end * plan.max_velocity, T)
        path = [profile.ahead(k * T) for k in range(int(3.0 / T))]
        volts = [gains.feedforward_velocity * p.velocity + gains.feedforward_acceleration
                 * p.acceleration for p in path]  # fmt: skip
        assert np.abs(np.diff(volts)).max() <= 40.0 * T
        assert path[-1].velocity == pytest.approx(end * plan.max_velocity)
    assert plan.lag == design(estimate(), LOOP).reference.lag
    assert one.loop.loop_delay == pytest.approx(0.01 + 0.5 * 12.0 / 40.0)
    assert one.specification.overshoot.high < 5.0


def test_gains_identified_at_one_voltage_amplitude_hold_at_others():
    """A driver that clipped in the recording has 20 % more gain at half the speed."""
    level = Finding("one_size_of_voltage", "warning", "the voltage has one size, 12 V")
    moves = {"dc_gain": 0.1 * TRUE["dc_gain"], "static_voltage": -0.1 * TRUE["static_voltage"]}
    error = Systematic("one_size_of_voltage", 0.1, moves)
    stated = replace(estimate(findings=[level]), systematic=(error,))
    aware, ignorant = design(stated, LOOP), design(estimate(), LOOP)
    more = {**TRUE, "dc_gain": 1.2 * TRUE["dc_gain"]}
    assert overshoot(ignorant, more) > ignorant.specification.overshoot.high + 2.0
    assert overshoot(aware, more) <= aware.specification.overshoot.high + 0.25
    assert aware.robustness.holds >= 0.99 and aware.gains.i < ignorant.gains.i
    assert any("one size" in words for words in aware.warnings)


def test_drives_within_the_uncertainty_stay_within_the_specified_bands():
    one = design(estimate(std=0.03), LOOP)
    spec, rng, held = one.specification, np.random.default_rng(8), []
    for _ in range(40):
        true = {n: v * math.exp(0.03 * rng.normal()) for n, v in TRUE.items()}
        time, speed = change(one, true)
        outside = np.flatnonzero(np.abs(speed - 1) > 0.02)
        settled = time[outside[-1] + 1]
        held.append(
            100 * (speed.max() - 1) <= spec.overshoot.high + 0.25
            and settled <= spec.settling.high + LOOP.sample_time
        )
    # 300 draws leave a share of 1/300 on each side; of 40 at most one by chance (99.2 %).
    assert sum(held) >= 39
    assert spec.settling.low <= one.performance.settling <= spec.settling.high
    assert spec.phase_margin.low >= 0.99 * 60
    assert spec.samples == 300


def margins_on(motor, made):
    """Return the margins of a design's gains with another motor."""
    return loop_margins(sample(motor, made.loop), made.feedback)


def test_stated_margins_cover_an_unidentified_second_lag():
    one_lag = estimate(time_constant_product=0.0)
    product = Quantity(None, None, (0.0, 4e-4), "s^2", "unidentifiable")
    hidden = replace(
        one_lag, combinations={**one_lag.combinations, "time_constant_product": product}
    )
    aware, ignorant = design(hidden, LOOP), design(one_lag, LOOP)
    motor = make_motors(estimate(time_constant_product=3.5e-4))

    real, unaware = margins_on(motor, aware), margins_on(motor, ignorant)
    assert real.phase > aware.specification.phase_margin.low > 59.0
    assert real.gain > aware.specification.gain_margin.low
    assert real.sensitivity < aware.specification.sensitivity.high
    assert unaware.phase < ignorant.specification.phase_margin.low - 3.0
    # The interval is limited to the lags that one motor can have.
    product = replace(product, ci95=(0.0, 1.0))
    wide = replace(hidden, combinations={**hidden.combinations, "time_constant_product": product})
    assert design(wide, LOOP).margins.stable


@pytest.mark.parametrize(
    ("stated", "other"),
    [
        ({"time_constant_product": 1e-3}, {"delay": 0.01, "time_constant": 0.09}),
        ({"sensor_lag": 0.01}, {"averaging_window": 0.02}),
    ],
    ids=["delay for second lag", "average for filter"],
)
def test_stated_margins_cover_motors_confounded_with_the_estimate(stated, other):
    loop = replace(LOOP, sample_time=0.005, delay=0.005)
    motor = {"time_constant": 0.1, "time_constant_product": 0.0}
    known = estimate(std=0.002, **{**motor, **stated})
    left_open = {**dict.fromkeys(stated, 0.0), **other}
    moves = {name: value - known.value(name) for name, value in left_open.items()}
    unseen = Systematic("delay", 1.0, moves)
    aware, ignorant = design(replace(known, systematic=(unseen,)), loop), design(known, loop)
    true = make_motors(estimate(**{**motor, **other}))

    real, unaware = margins_on(true, aware), margins_on(true, ignorant)
    assert real.gain > aware.specification.gain_margin.low
    assert real.sensitivity < aware.specification.sensitivity.high
    assert unaware.gain < 0.9 * ignorant.specification.gain_margin.low
    assert unaware.sensitivity > ignorant.specification.sensitivity.high + 0.03


def test_unreliable_identification_is_refused_or_lowers_the_gains_if_accepted():
    with pytest.raises(DesignError, match=r"unreliable: a dead zone of 2 V \(record slow ramps\)"):
        design(estimate(findings=[DOUBT]), LOOP)
    sure = design(estimate(), LOOP)
    wide = design(estimate(findings=[DOUBT]), LOOP, accept_unreliable=True)
    assert wide.gains.i < 0.95 * sure.gains.i
    assert wide.specification.settling.high > sure.specification.settling.high
    assert any("unreliable identification" in words for words in wide.warnings)
    # Notes and warnings do not cause a refusal.
    assert design(estimate(findings=[replace(DOUBT, severity="warning")]), LOOP).gains == sure.gains


def with_friction(quantity: Quantity) -> Estimate:
    one = estimate()
    names = tuple(n for n in one.names if n != "static_voltage")
    keep = [one.names.index(n) for n in names]
    known = {**one.combinations, "static_voltage": quantity}
    return replace(
        one, combinations=known, names=names, covariance=one.covariance[np.ix_(keep, keep)]
    )


@pytest.mark.parametrize(
    "quantity",
    [Quantity(0.0, 1.1e6), Quantity(None, status="unidentifiable"), Quantity(1.0, math.inf)],
)
def test_unknown_friction_is_refused_with_advice_on_recording(quantity):
    with pytest.raises(DesignError, match="record the motor at two or more voltages"):
        design(with_friction(quantity), LOOP)


def test_the_lower_end_of_a_friction_range_is_fed_forward():
    one = design(with_friction(Quantity(1.0, 0.5, (0.6, 2.4))), LOOP)
    assert one.gains.feedforward_static == 0.6
    assert any("between 0.6 and 2.4 V" in words for words in one.warnings)
    for friction in (0.6, 1.5, 2.4):
        true = {**TRUE, "static_voltage": friction}
        assert overshoot(one, true) <= one.specification.overshoot.high + 0.25
    # The reference leaves voltage for the upper end of the range.
    assert one.reference.max_velocity <= 25.0 * (0.92 * 12.0 - 2.4)


def test_integral_gain_with_coarse_counts_is_near_the_optimum_of_a_grid():
    """No PI gains of a dense grid within margins and control noise are far better."""
    loop = replace(LOOP, counts_per_revolution=48.0, noise_voltage=0.48)
    one = design(estimate(), loop, structure="pi")
    problem = Problem(sample(make_motors(estimate()), loop), loop)
    best = 0.0
    for p in np.geomspace(0.002, 0.3, 40):
        for i in np.geomspace(0.05, 10.0, 40):
            feedback = Feedback(float(p), float(i))
            if i > best and problem.control_noise(feedback) <= 0.48:
                omega, T = problem.omega, loop.sample_time
                gain = problem.response * feedback.response(omega, T)
                m, hump = batch_margins(gain[None], omega), np.abs(gain / (1 + gain)).max()
                good = m.phase[0] >= 60 and m.sensitivity[0] <= 1.4 and hump <= 1.25
                if good and spectral_radius(problem.plant, feedback)[0] < 1:
                    best = float(i)
    # The uncertainty of the motor, 1 %, is not in the grid.
    assert one.gains.i >= 0.85 * best


def test_command_refuses_an_unreliable_result_unless_it_is_accepted(tmp_path, capsys):
    source, output = tmp_path / "identification.json", tmp_path / "gains.yaml"
    source.write_text(json.dumps(identification_document({"left": estimate(findings=[DOUBT])})))
    assert tune([str(source), "--output", str(output)]) == 1
    assert "a dead zone of 2 V" in capsys.readouterr().err
    assert not output.exists()
    assert tune([str(source), "--output", str(output), "--accept-unreliable"]) == 0
    assert "designed on an unreliable identification" in capsys.readouterr().out
    entry = json.loads(output.with_suffix(".json").read_text())["wheels"]["left"]
    assert entry["findings"][0]["code"] == "unreliable_identification"
    for name in ("overshoot", "settling", "phase_margin", "gain_margin", "sensitivity"):
        band = entry["specification"][name]
        assert band["low"] <= band["value"] <= band["high"]


@pytest.mark.parametrize("seed", range(6))
def test_gains_are_stable_for_random_inductance_and_sampling_rate(seed):
    """The short version of ``benchmarks/random_designs.py``."""
    rng = np.random.default_rng(seed)
    electrical, rate = 10 ** rng.uniform(-5, -2), 20 * 250 ** rng.uniform()
    values = {
        "time_constant": 0.03 + electrical,
        "time_constant_product": 0.03 * electrical,
        "averaging_window": rng.uniform(0, 3) / rate,
    }
    source = ("measured", "difference", "observer")[seed % 3]
    loop = replace(LOOP, sample_time=1 / rate, delay=None, speed_source=source)
    one = design(estimate(**values), loop, samples=60)
    assert one.margins.stable
    assert one.performance.overshoot < 5.0
    assert math.isfinite(one.specification.settling.value)


def test_delay_uncertainty_of_a_fast_loop_is_limited_by_its_delay_margin():
    """Two milliseconds are ten samples at 5 kHz: such a delay would make the loop unstable."""
    fast = replace(LOOP, sample_time=2e-4, delay=2e-4, counts_per_revolution=None)
    quick = {"time_constant": 0.01, "time_constant_product": 0.0}
    one = design(estimate(0.002, **quick), fast, together=False)
    assert one.margins.delay < 2 * fast.delay_doubt
    assert one.reference.doubt == pytest.approx(0.5 * one.margins.delay)
    assert one.reference.transition_time < 0.1


def test_stated_gain_margin_is_capped_beyond_the_recorded_band():
    """That phase crossing depends on half a row of delay, which no record excludes."""
    loop = replace(LOOP, sample_time=0.001, delay=None, counts_per_revolution=28.0)
    one = design(estimate(time_constant=0.03, time_constant_product=0.0), loop)
    band = one.specification.gain_margin
    late = make_motors(estimate(time_constant=0.03, time_constant_product=0.0, delay=0.0005))
    true = loop_margins(sample(late, one.loop), one.feedback).gain
    assert 10.0 == band.low < true < 0.97 * band.value


SUPPLY = 12.0
Z95 = 1.959963985  # of the normal distribution


def make_friction_estimate(quantity: Quantity | None, **parameters: Quantity) -> Estimate:
    combinations = {} if quantity is None else {"static_voltage": quantity}
    return Estimate("front_left", "first_order", parameters, combinations)


def test_a_standard_deviation_alone_gives_a_normal_interval():
    found = bound_friction(make_friction_estimate(Quantity(1.0, 0.1)), SUPPLY)
    assert (found.low, found.high) == pytest.approx((1.0 - Z95 * 0.1, 1.0 + Z95 * 0.1), abs=1e-4)
    assert found.known == found.planned == 1.0 and found.finding is None


@pytest.mark.parametrize(("half", "known"), [(0.239, True), (0.241, False)])
def test_friction_is_known_if_its_interval_is_within_2_percent_of_supply(half, known):
    found = bound_friction(
        make_friction_estimate(Quantity(1.0, 0.1, (1.0 - half, 1.0 + half))), SUPPLY
    )
    assert found.known == (1.0 if known else 1.0 - half)
    assert found.planned == (1.0 if known else 1.0 + half)
    assert (found.finding is None) is known
    if found.finding is not None:
        assert found.finding.code == "friction_range"
        assert found.finding.evidence == {"low": 1.0 - half, "high": 1.0 + half}


def test_friction_interval_is_clipped_to_zero_and_supply():
    found = bound_friction(make_friction_estimate(Quantity(0.1, 0.5, (-0.9, 1.1))), SUPPLY)
    assert (found.low, found.high) == (0.0, 1.1)
    found = bound_friction(make_friction_estimate(Quantity(10.0, 2.0, (8.0, 14.0))), SUPPLY)
    assert (found.low, found.high) == (8.0, SUPPLY)
    fixed = bound_friction(
        make_friction_estimate(Quantity(13.0, None, None, status="fixed")), SUPPLY
    )
    assert (fixed.low, fixed.high, fixed.known) == (13.0, 13.0, 13.0), "the user's word"


@pytest.mark.parametrize(("width", "refused"), [(5.99, False), (6.01, True)])
def test_friction_interval_wider_than_half_the_supply_is_refused(width, refused):
    given = make_friction_estimate(Quantity(None, None, (0.0, width), status="unidentifiable"))
    if refused:
        with pytest.raises(DesignError, match=r"anything from 0 to 6\.01 V of the 12 V supply"):
            bound_friction(given, SUPPLY)
    else:
        assert bound_friction(given, SUPPLY).high == width


def test_unidentified_friction_is_left_to_integral_action():
    found = bound_friction(make_friction_estimate(None), SUPPLY)
    assert (found.known, found.low, found.high) == (0.0, 0.0, 0.0)
    assert found.finding is not None and found.finding.code == "friction_unknown"
    for nothing in (Quantity(None), Quantity(1.0, math.inf)):
        with pytest.raises(DesignError, match="from 0 to 12 V"):
            bound_friction(make_friction_estimate(nothing), SUPPLY)


def test_friction_torque_is_converted_to_voltage_by_resistance_and_motor_constant():
    parts = {"resistance": Quantity(12.0, 0.0), "motor_constant": Quantity(0.02, 0.0)}
    given = make_friction_estimate(None, coulomb_friction=Quantity(1e-3, 1e-5), **parts)
    found = bound_friction(given, SUPPLY)
    assert found.known == pytest.approx(0.6)  # R T / K
    assert found.high - found.low == pytest.approx(2 * Z95 * 0.006, rel=1e-4)
