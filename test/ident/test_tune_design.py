# SPDX-License-Identifier: Apache-2.0
"""design, compare and the wheels together: units, robustness, refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest
from paper_motors import TABLE_1

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate, Quantity
from smp_motor_ident.tune import METHODS, Loop, compare, design, design_wheels, recommend
from smp_motor_ident.tune.case import UncertaintyEnsemble
from smp_motor_ident.tune.motors import draw_motors
from smp_motor_ident.tune.plant import sample

TABLE = tuple(TABLE_1.values())
PHYSICAL = ("resistance", "inductance", "motor_constant", "inertia", "viscous_friction")


def combinations(row):
    R, L, K, J, b = row
    a0, a1, a2 = (R * b + K * K) / K, (R * J + L * b) / K, L * J / K
    return {"dc_gain": 1 / a0, "time_constant": a1 / a0, "time_constant_product": a2 / a0}


def estimate(k=0, std=0.0, **more) -> Estimate:
    values = {**combinations(TABLE[k]), **more}
    covariance = np.diag([(std * x) ** 2 for x in values.values()])
    known = {name: Quantity(value) for name, value in values.items()}
    return Estimate("front_left", "second_order", {}, known, tuple(values), covariance)


def of_parameters(row) -> Estimate:
    known = {name: Quantity(value) for name, value in zip(PHYSICAL, row, strict=True)}
    return Estimate("front_left", "electromechanical", known, {})


@pytest.mark.parametrize("k", range(4))
@pytest.mark.parametrize("method", ["margin", "simc"])
def test_combinations_alone_give_the_gains_of_the_true_parameters(k, method):
    loop = Loop()
    known = design(estimate(k), loop, method).gains
    true = design(of_parameters(TABLE[k]), loop, method).gains
    for name in ("p", "i", "d", "feedforward_velocity", "feedforward_acceleration"):
        assert getattr(known, name) == pytest.approx(getattr(true, name), rel=1e-6, abs=1e-12)


def test_identified_combinations_give_the_gains_of_the_true_ones_within_two_percent():
    rng = np.random.default_rng(3)
    loop = Loop()
    true = design(estimate(), loop).gains
    for _ in range(5):
        # 0.1 % exceeds the standard deviations of 30 s of Fourier voltage.
        wrong = {n: v * (1 + 1e-3 * rng.normal()) for n, v in combinations(TABLE[0]).items()}
        gains = design(estimate(0, std=1e-3, **wrong), loop).gains
        for name in ("p", "i", "d"):
            assert getattr(gains, name) == pytest.approx(getattr(true, name), rel=0.02)


def test_gains_are_volts_per_wheel_speed():
    direct = design(estimate(), Loop(gear_ratio=1.0)).gains
    geared = design(estimate(), Loop(gear_ratio=65.5)).gains
    for name in ("p", "i", "d", "feedforward_velocity", "feedforward_acceleration"):
        assert getattr(geared, name) == pytest.approx(65.5 * getattr(direct, name))
    assert geared.tracking_time_constant == pytest.approx(direct.tracking_time_constant)
    assert geared.u_clamp_max == 12.0


def test_feed_forward_inverts_the_motor_equation():
    one = combinations(TABLE[2])
    gains = design(estimate(2, static_voltage=0.35), Loop(gear_ratio=10.0)).gains
    assert gains.feedforward_velocity == pytest.approx(10.0 / one["dc_gain"])
    assert gains.feedforward_acceleration == pytest.approx(
        10.0 * one["time_constant"] / one["dc_gain"]
    )
    assert gains.feedforward_static == 0.35


@pytest.mark.parametrize("method", METHODS)
def test_gains_hold_for_99_percent_of_an_uncertain_motor(method):
    one = design(estimate(1, std=0.05), Loop(), method)
    assert one.robustness.samples == 1000
    assert one.robustness.stable == 1.0
    assert one.robustness.holds >= 0.99


def test_uncertainty_reduces_the_gains_with_a_stated_reason():
    sure, unsure = design(estimate(1), Loop()), design(estimate(1, std=0.15), Loop())
    assert unsure.gains.i < sure.gains.i
    assert "gains reduced to" in unsure.reason
    assert "gains reduced" not in sure.reason
    assert any("no uncertainty" in warning for warning in sure.warnings)


def test_robustness_holds_on_an_independent_sample_of_motors():
    """Gains chosen on one sample of the distribution hold on another, with another seed."""
    one = design(estimate(1, std=0.05), Loop(), seed=1)
    fresh = sample(draw_motors(estimate(1, std=0.05), 4000, np.random.default_rng(99)), Loop())
    verdict = UncertaintyEnsemble(fresh, METHODS["margin"].required).assess(one.feedback)
    # 99 % minus three binomial standard deviations of a fresh sample, 0.3 % each.
    assert verdict.holds >= 0.98
    assert verdict.stable == 1.0


def test_longer_delay_or_lower_rate_reduces_the_bandwidth():
    fast = design(estimate(), Loop(sample_time=0.005, delay=0.001))
    late = design(estimate(), Loop(sample_time=0.005, delay=0.015))
    slow = design(estimate(), Loop(sample_time=0.02))
    assert fast.margins.crossover > late.margins.crossover > 0
    assert fast.margins.crossover > slow.margins.crossover


def test_identified_delay_adds_to_the_loop_delay():
    inside = design(estimate(delay=0.004), Loop(delay=0.003))
    outside = design(estimate(), Loop(delay=0.007))
    assert inside.gains.p == pytest.approx(outside.gains.p, rel=1e-9)
    assert inside.reference.lag == pytest.approx(outside.reference.lag)


@pytest.mark.parametrize(
    ("targets", "words"),
    [
        ({"max_velocity": 6.0}, "max_velocity 6 rad/s is beyond the motor"),
        ({"max_acceleration": 1e5}, "max_acceleration 1e\\+05 rad/s\\^2 is beyond the motor"),
        ({"transition_time": 0.01}, "transition_time 0.01 s is too short"),
        ({"bandwidth": 400.0}, "the nearest that holds is"),
        ({"phase_margin": -5.0}, "phase_margin is -5"),
        ({"phase_margin": math.nan}, "phase_margin is nan"),
        ({"maximum_sensitivity": 0.9}, "maximum_sensitivity is 0.9"),
        ({"focus": "sport"}, "focus is 'sport'"),
        ({"gain": 1.0}, "has no target 'gain'"),
        ({"bandwidth": 1e-6}, "bandwidth 1e-06 rad/s cannot keep"),
        ({"bandwidth": "fast"}, "bandwidth is 'fast'; it must be a finite number"),
        ({"maximum_sensitivity": 1.01}, "the nearest that holds has Ms 1.05"),
        ({"structure": "p"}, "structure is 'p'; it must be pi or pid"),
        ({"max_velocity": -1.0}, "max_velocity is -1.0"),
        ({"max_acceleration": math.nan}, "max_acceleration is nan"),
        ({"transition_time": math.inf}, "transition_time is inf"),
        ({"samples": -5}, "samples is -5"),
    ],
)
def test_impossible_demand_is_refused_with_the_limit(targets, words):
    with pytest.raises(DesignError, match=words):
        design(estimate(), Loop(), **targets)


@pytest.mark.parametrize(
    ("loop", "words"),
    [
        (Loop(sample_time=1e-5, delay=0.5), "Sample at 600 Hz or less"),
        (Loop(difference_window=1000), "average over fewer samples"),
        (Loop(supply_voltage=1e-3),
         "the nearest that holds has a control_noise of|no similar design"),
    ],
)  # fmt: skip
def test_an_impossible_loop_is_refused_with_advice(loop, words):
    with pytest.raises(DesignError, match=words):
        design(estimate(), loop)


def test_a_low_phase_margin_is_accepted():
    # Ms 1.4 leaves 42 deg in any case.
    assert design(estimate(), Loop(), phase_margin=1.0).margins.phase > 41.0


def test_the_acceleration_named_in_a_refusal_is_accepted():
    with pytest.raises(DesignError) as refusal:
        design(estimate(), Loop(), max_acceleration=1e5)
    words = str(refusal.value).split()
    limit = float(words[words.index("reaches") + 1])
    one = design(estimate(), Loop(), max_acceleration=0.999 * limit)
    assert one.reference.max_acceleration / 65.5 <= limit


def test_motor_held_by_friction_is_refused():
    with pytest.raises(DesignError, match="cannot turn"):
        design(estimate(static_voltage=11.5), Loop())


def test_estimate_without_dynamics_is_refused():
    bare = Estimate("rear_left", "static_gain", {}, {"dc_gain": Quantity(25.0)})
    with pytest.raises(DesignError, match="rear_left: the estimate has neither"):
        design(bare, Loop())


def test_comparison_recommends_a_robust_design_with_a_reason():
    results = compare(estimate(0, std=0.01), Loop())
    assert set(results) == set(METHODS)
    name, reason = recommend(results)
    chosen = results[name]
    assert chosen.margins.sensitivity <= 1.6
    assert "load" in reason
    for other in results.values():
        sound = other.margins.sensitivity <= 1.6
        if sound and other.performance.control_noise <= other.loop.noise_limit:
            assert chosen.performance.load_integral <= other.performance.load_integral


def test_draws_have_the_mean_and_covariance_of_the_estimate():
    names, n = ("dc_gain", "time_constant"), 100_000
    covariance = np.array([[0.25, 6e-4], [6e-4, 4e-6]])
    values = (25.5, 0.05)
    uncertain = Estimate(
        "w", "m", {}, {k: Quantity(v) for k, v in zip(names, values)}, names=names,
        covariance=covariance,
    )  # fmt: skip
    drawn = draw_motors(uncertain, n, np.random.default_rng(1))
    draws = np.array([1 / drawn.a0, drawn.a1 / drawn.a0])
    # Standard error of a mean is std/sqrt(n); of a variance, relative sqrt(2/n) = 0.4 %.
    std = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(draws.mean(1) - values) < 5 * std / np.sqrt(n))
    np.testing.assert_allclose(np.cov(draws), covariance, rtol=0.03)


def test_draws_of_positive_quantities_stay_positive_however_uncertain():
    vague = Estimate(
        "w", "m", {}, {"dc_gain": Quantity(25.0), "time_constant": Quantity(0.05)},
        names=("time_constant",), covariance=np.array([[0.01]]),
    )  # fmt: skip
    drawn = draw_motors(vague, 10_000, np.random.default_rng(2))
    assert np.all(drawn.a1 / drawn.a0 > 0) and np.all(1 / drawn.a0 == 25.0)


def test_comparison_returns_refusals_per_method():
    results = compare(estimate(), Loop(), bandwidth=1000.0)
    assert isinstance(results["margin"], DesignError)
    assert not isinstance(results["simc"], DesignError)


def four(spread: float) -> dict[str, Estimate]:
    rng = np.random.default_rng(5)
    found = {}
    for wheel in ("front_left", "front_right", "rear_left", "rear_right"):
        values = {n: v * (1 + spread * rng.normal()) for n, v in combinations(TABLE[3]).items()}
        found[wheel] = replace(estimate(3, std=0.002, **values), wheel=wheel)
    return found


def test_similar_motors_share_one_set_of_gains():
    found = four(0.005)
    wheels = design_wheels(found, dict.fromkeys(found, Loop()))
    assert wheels.reason.startswith("one set of gains for all")
    assert len({(d.gains.p, d.gains.i, d.gains.d) for d in wheels.designs.values()}) == 1
    for one in wheels.designs.values():
        assert one.robustness.holds >= 0.99


def test_different_motors_get_separate_gains_and_a_common_reference():
    found = {f"wheel_{k}": replace(estimate(k), wheel=f"wheel_{k}") for k in range(4)}
    wheels = design_wheels(found, dict.fromkeys(found, Loop()))
    assert wheels.reason.startswith("one set of gains each")
    assert len({d.gains.p for d in wheels.designs.values()}) == 4
    plans = [d.reference for d in wheels.designs.values()]
    for name in ("transition_time", "max_velocity", "max_acceleration"):
        assert len({round(getattr(plan, name), 9) for plan in plans}) == 1


def test_common_gains_for_different_motors_are_robust_for_all():
    found = {f"wheel_{k}": replace(estimate(k, 0.01), wheel=f"wheel_{k}") for k in range(4)}
    wheels = design_wheels(found, dict.fromkeys(found, Loop()), sets="one")
    assert wheels.reason.startswith("one set of gains for all")
    for one in wheels.designs.values():
        assert one.robustness.holds >= 0.99


def test_coordinated_wheels_share_the_limits_of_the_weakest():
    found = {f"wheel_{k}": replace(estimate(k), wheel=f"wheel_{k}") for k in range(4)}
    loops = dict.fromkeys(found, Loop())
    together = design_wheels(found, loops)
    alone = design_wheels(found, loops, together=False)
    tops = {round(d.reference.drive.top_speed, 9) for d in together.designs.values()}
    assert len(tops) == 1
    assert len({d.reference.drive.top_speed for d in alone.designs.values()}) == 4
    for wheel, one in together.designs.items():
        assert one.reference.drive.top_speed <= alone.designs[wheel].reference.drive.top_speed
        # Each motor stays within its own 95 % of 12 V along the common change, apart from peaks
        # between the evaluated instants.
        motor, profile = combinations(TABLE[int(wheel[-1])]), one.reference.profile()
        profile.set_target(0.9 * one.reference.max_velocity, 0.005)
        seen = [profile.ahead(k * 1e-4) for k in range(int(profile.duration / 1e-4))]
        needed = [
            r.velocity + motor["time_constant"] * r.acceleration
            + motor["time_constant_product"] * r.jerk
            for r in seen
        ]  # fmt: skip
        assert max(needed) / motor["dc_gain"] <= 0.95 * 12.0 * 1.01
