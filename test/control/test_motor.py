# SPDX-License-Identifier: Apache-2.0
"""The motor model compared with independent integrators and exponentials, and its friction."""

import math

import numpy as np
import pytest
from paper_motors import TABLE_1, combinations_of, paper_motor
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from smp_motor_control.errors import ParameterError
from smp_motor_control.motor import Gearbox, Motor, MotorParameters
from smp_motor_control.motor.response import zero_order_hold


def reference_step(p: MotorParameters, state, voltage, dt, load):
    """Return the state after one interval, by an adaptive integrator with friction events."""
    i, w, angle = state
    t = 0.0

    def drive(i):
        return p.motor_constant * i - load

    released = 0.0  # direction in which the rotor has just broken loose
    for _ in range(50):
        stuck = w == 0.0 and released == 0.0 and abs(drive(i)) <= p.coulomb_friction
        sign = 0.0 if stuck else math.copysign(1.0, w or released or drive(i))

        def field(_, x, sign=sign, stuck=stuck):
            di = (voltage - p.resistance * x[0] - p.motor_constant * x[1]) / p.inductance
            if stuck:
                return [di, 0.0, 0.0]
            torque = p.motor_constant * x[0] - p.viscous_friction * x[1]
            return [di, (torque - p.coulomb_friction * sign - load) / p.inertia, x[1]]

        def event(_, x, sign=sign, stuck=stuck):
            return abs(drive(x[0])) - p.coulomb_friction if stuck else x[1] * sign

        event.terminal = True  # a short first step, so that the start is no crossing
        event.direction = 1.0 if stuck else -1.0
        solution = solve_ivp(
            field, (t, dt), [i, w, angle], "DOP853", events=event, rtol=1e-11,
            atol=[1e-12, 1e-10, 1e-11], max_step=(dt - t) / 20,
            first_step=min(1e-7, dt - t),
        )  # fmt: skip
        i, w, angle = solution.y[:, -1]
        t = solution.t[-1]
        if solution.status == 0:
            return i, 0.0 if stuck else w, angle
        w = 0.0
        released = math.copysign(1.0, drive(i)) if stuck else 0.0
    raise AssertionError("more than 50 changes of mode in one interval")


def random_case(rng: np.random.Generator):
    wheel = tuple(TABLE_1)[rng.integers(4)]
    inductance = TABLE_1[wheel][1] * 10 ** rng.uniform(-2, 1)
    return paper_motor(wheel, static_voltage=rng.uniform(0.2, 2.0), inductance=inductance)


@pytest.mark.parametrize("seed", range(12))
def test_step_matches_adaptive_integrator_through_stiction_and_reversal(seed):
    rng = np.random.default_rng(seed)
    p = random_case(rng)
    motor = Motor(p)
    state = (0.0, 0.0, 0.0)
    load = 0.0
    for _ in range(40):
        voltage = float(rng.choice([0.0, rng.uniform(-3, 3), rng.uniform(-12, 12)]))
        dt = float(10 ** rng.uniform(-3.5, -0.7))
        if rng.uniform() < 0.3:
            load = float(rng.uniform(-2, 2)) * p.coulomb_friction
        state = reference_step(p, state, voltage, dt, load)
        motor.step(voltage, dt, load)
        # The integrator's own tolerance is 1e-11 relative over some hundred steps an interval.
        assert motor.current == pytest.approx(state[0], abs=2e-8)
        assert motor.speed == pytest.approx(state[1], abs=2e-6)
        assert motor.angle == pytest.approx(state[2], abs=2e-7)


@pytest.mark.parametrize("wheel", TABLE_1)
@pytest.mark.parametrize("inductance", [0.0, 1e-9, 1e-4, None])
def test_one_long_step_equals_many_short_ones(wheel, inductance):
    p = paper_motor(wheel, static_voltage=0.6, inductance=inductance)
    whole, parts = Motor(p), Motor(p)
    for voltage in (8.0, -3.0, 0.3, 0.0, -0.7, 11.0):
        whole.step(voltage, 0.317)
        for _ in range(200):
            parts.step(voltage, 0.317 / 200)
        # Both are exact up to rounding, which 200 steps let grow to some 1e-12 of the state.
        assert parts.speed == pytest.approx(whole.speed, abs=1e-8)
        assert parts.angle == pytest.approx(whole.angle, abs=1e-8)
        assert parts.current == pytest.approx(whole.current, abs=1e-9)


def test_zero_crossing_of_underdamped_motor_within_long_step_is_detected():
    p = MotorParameters(
        resistance=0.5, inductance=0.5, motor_constant=0.05, inertia=1e-4,
        viscous_friction=0.0, coulomb_friction=1e-4,
    )  # fmt: skip
    whole, parts = Motor(p), Motor(p)
    whole.speed = parts.speed = 30.0
    whole.step(0.2, 8.0)
    for _ in range(4000):
        parts.step(0.2, 0.002)
    assert whole.speed == pytest.approx(parts.speed, abs=1e-8)
    assert whole.angle == pytest.approx(parts.angle, abs=1e-7)


@pytest.mark.parametrize("inductance", [0.0, 0.05])
def test_motor_sticks_below_the_static_voltage_and_turns_above(inductance):
    p = paper_motor("rear_right", static_voltage=0.5, inductance=inductance)
    motor = Motor(p)
    motor.step(0.499, 60.0)
    assert motor.speed == 0.0 and motor.angle == 0.0
    motor.step(0.501, 60.0)
    assert motor.speed > 0.0


def test_resting_motor_turns_only_under_load_above_friction():
    p = paper_motor("rear_left", static_voltage=0.5)
    motor = Motor(p)
    motor.step(0.0, 5.0, 0.99 * p.coulomb_friction)
    assert motor.angle == 0.0
    motor.step(0.0, 5.0, 1.01 * p.coulomb_friction)
    assert motor.speed < 0.0


def test_vanishing_inductance_approaches_zero_inductance():
    tiny, none = (Motor(paper_motor("rear_right", 0.5, inductance=x)) for x in (1e-12, 0.0))
    for voltage in (5.0, -4.0, 0.2):
        tiny.step(voltage, 0.05)
        none.step(voltage, 0.05)
    assert tiny.speed == pytest.approx(none.speed, rel=1e-6)
    assert tiny.current == pytest.approx(none.current, rel=1e-6)


def rebuild_from_combinations(p: MotorParameters) -> MotorParameters:
    return MotorParameters.from_combinations(**combinations_of(p), resistance=3.0)


def test_parameter_combinations_round_trip():
    p = paper_motor("front_left", static_voltage=0.4)
    for name in ("a0", "a1", "a2", "static_voltage"):
        assert getattr(rebuild_from_combinations(p), name) == pytest.approx(
            getattr(p, name), rel=1e-12
        )


def test_motor_from_parameter_combinations_has_original_response():
    # Exact without dry friction, and with it where there is no viscous friction.
    sliding = paper_motor("front_left")
    rubbing = MotorParameters(
        resistance=3.0, inductance=0.05, motor_constant=0.03, inertia=2e-5,
        viscous_friction=0.0, coulomb_friction=0.005,
    )  # fmt: skip
    for p in (sliding, rubbing):
        one, two = Motor(p), Motor(rebuild_from_combinations(p))
        for voltage in (7.0, -0.3, -5.0, 0.2):
            one.step(voltage, 0.05)
            two.step(voltage, 0.05)
            assert two.speed == pytest.approx(one.speed, abs=1e-9)


@pytest.mark.parametrize("bad", [(math.nan, 0.01, 0.0), (1.0, -0.01, 0.0), (1.0, 0.01, math.inf)])
def test_invalid_step_is_refused_and_leaves_state_unchanged(bad):
    motor = Motor(paper_motor("front_left"))
    motor.speed = 3.0
    with pytest.raises(ParameterError):
        motor.step(*bad)
    assert motor.speed == 3.0


def test_gearbox_conversion_round_trips_and_zero_ratio_is_refused():
    gearbox = Gearbox(65.5)
    assert gearbox.to_wheel(gearbox.to_motor(2.5)) == pytest.approx(2.5, rel=1e-15)
    with pytest.raises(ParameterError, match="gear ratio"):
        Gearbox(0.0)


GAIN, TAU = 20.0, 0.05
# tp / tau^2: oscillating, a double root, real roots, and L/R of 50 us and 50 ns.
SHARES = (30.0, 1.0, 0.25, 0.2, 1e-3, 1e-6)


def by_exponential(tau: float, tp: float, t: float) -> np.ndarray:
    """Return the transition of speed, acceleration, angle and voltage by a scaled exponential."""
    A = np.zeros((4, 4))
    A[0, 1], A[2, 0] = 1.0, 1.0
    A[1] = [-1.0 / tp, -tau / tp, 0.0, GAIN / tp]
    # Pieces short enough that the exponential loses no digits, then multiplied.
    pieces = 2 ** max(int(np.ceil(np.log2(max(t * tau / tp, 1.0)))), 0)
    return np.linalg.matrix_power(expm(A * t / pieces), pieces)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("interval", [1e-4, 1e-3, 0.02])
def test_zero_order_hold_response_matches_matrix_exponential(share, interval):
    tp = share * TAU**2
    held = zero_order_hold(GAIN, TAU, tp, interval)
    truth = by_exponential(TAU, tp, interval)
    size = np.array([1.0, 1.0 / TAU])  # of speed and acceleration
    # Rounding: 1e-16 of each entry, times up to 2^20 products of the pieces of the truth.
    tolerance = 1e-9
    scaled = (held.transition[0] - truth[:2, :2]) / size[:, None] * size
    assert np.abs(scaled).max() < tolerance
    assert np.abs((held.forced[0] - truth[:2, 3]) / size).max() < tolerance * GAIN
    assert held.angle_transition[0] * size == pytest.approx(truth[2, :2] * size, abs=1e-11)
    assert held.angle_forced[0] == pytest.approx(truth[2, 3], abs=1e-10)


def test_fast_electrical_pole_reduces_to_first_order_response():
    # With L/R of 1 ns and 50 ms the two differ by their ratio, 2e-8.
    second = zero_order_hold(GAIN, TAU, 1e-9 * TAU, 0.05)
    first = zero_order_hold(GAIN, TAU, 0.0, 0.05)
    assert second.forced == pytest.approx(first.forced, rel=1e-7)
    assert second.angle_forced == pytest.approx(first.angle_forced, rel=1e-7)
    for values in second:
        assert np.all(np.isfinite(values))
