# SPDX-License-Identifier: Apache-2.0
"""The whole control law, with both degrees of freedom, compared with its equations.

e = r - y,   P = p (b r - y),   D = d f(c r - y)',   F = kv r + ka a + ks sign(r or a)
unsaturated = P + I + D + F,   output = its clamp,   I += dt (i e + anti-windup), clamped
"""

import math
import random
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smp_motor_control.errors import ParameterError
from smp_motor_control.pid import EPSILON, STRATEGIES, Pid, PidGains

ROUNDING = 1e-9  # terms of up to 1e3 V are added in another order


def clamp(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


class Law:
    """The law, step by step; derivatives by first differences filtered by backward Euler."""

    def __init__(self, gains: PidGains) -> None:
        self.g = gains
        self.integral = self.rate = 0.0
        self.before: float | None = None
        self.seen = (0.0, 0.0, 0.0)

    def feedforward(self, r: float, a: float) -> float:
        g, goes = self.g, r if r != 0.0 else a
        sign = (goes > 0.0) - (goes < 0.0)
        return (
            g.feedforward_velocity * r
            + g.feedforward_acceleration * a
            + g.feedforward_static * sign
        )

    def tracking(self) -> float:
        g = self.g
        if g.tracking_time_constant > 0.0 or g.i == 0.0:
            return g.tracking_time_constant
        return math.sqrt(abs(g.d / g.i)) if g.d else abs(g.p / g.i)

    def step(self, r: float, y: float, dt: float, a: float, given: float | None) -> dict:
        g, filtered = self.g, self.g.derivative_filter_time_constant
        shown = g.setpoint_weight_d * r - y
        if given is None:
            before = g.setpoint_weight_d * y - y if self.before is None else self.before
            change, self.before = shown - before, shown
        else:
            change = given * dt
        self.rate = (filtered * self.rate + change) / (filtered + dt)
        p, d = g.p * (g.setpoint_weight_p * r - y), g.d * self.rate
        f = self.feedforward(r, a)
        u = p + self.integral + d + f
        out = clamp(u, g.u_clamp_min, g.u_clamp_max)
        e, excess, growth = r - y, out - u, 0.0
        if abs(e) > g.error_deadband:
            growth = dt * g.i * e
            if g.antiwindup_strategy == "back_calculation":
                t = self.tracking()
                growth += (dt / t if t > 0.0 else 1.0) * excess
                growth = growth if g.i != 0.0 else 0.0
            elif g.antiwindup_strategy == "conditional_integration" and excess and e * u > 0.0:
                growth = 0.0
        if growth:
            self.integral = clamp(self.integral + growth, g.i_clamp_min, g.i_clamp_max)
        self.seen = (r, y, a)
        return {"output": out, "unsaturated": u, "p_term": p, "i_term": self.integral, "d_term": d,
                "feedforward": f}  # fmt: skip

    def at_rest(self) -> float:
        """Return the command at the last inputs without the integral."""
        g, (r, y, a) = self.g, self.seen
        return g.p * (g.setpoint_weight_p * r - y) + g.d * self.rate + self.feedforward(r, a)


def drawn_gains(draw: random.Random) -> PidGains:
    some = lambda high: draw.choice([0.0, draw.uniform(0.1, 1.0) * high])  # noqa: E731
    limit = lambda: draw.choice([math.inf, draw.uniform(1.0, 24.0)])  # noqa: E731
    return PidGains(
        p=some(5.0), i=some(50.0), d=some(0.5), u_clamp_min=-limit(), u_clamp_max=limit(),
        i_clamp_min=-limit(), i_clamp_max=limit(), antiwindup_strategy=draw.choice(STRATEGIES),
        tracking_time_constant=some(0.2), error_deadband=some(0.3),
        setpoint_weight_p=draw.uniform(0.0, 1.0), setpoint_weight_d=draw.uniform(0.0, 1.0),
        derivative_filter_time_constant=some(0.05), feedforward_static=some(1.0),
        feedforward_velocity=some(3.0), feedforward_acceleration=some(0.3),
    )  # fmt: skip


PUBLISHED = dict(
    setpoint_weight_p=1.0, setpoint_weight_d=1.0, derivative_filter_time_constant=0.0,
    feedforward_static=0.0, feedforward_velocity=0.0, feedforward_acceleration=0.0,
)  # fmt: skip
"""With these the law is the published rule of control_toolbox's ``Pid`` (jazzy, 05de3c67)."""


@pytest.mark.parametrize("fixed", [{}, PUBLISHED], ids=["law", "published rule"])
@pytest.mark.parametrize("seed", range(10))
def test_every_term_of_random_controllers_matches_the_control_law(seed, fixed):
    draw = random.Random(seed)
    for _ in range(20):
        gains = replace(drawn_gains(draw), **fixed)
        law, pid = Law(gains), Pid(gains)
        for _ in range(40):
            r, y = draw.choice([0.0, draw.uniform(-5.0, 5.0)]), draw.uniform(-5.0, 5.0)
            dt, a = draw.uniform(1e-3, 0.05), draw.choice([0.0, draw.uniform(-20.0, 20.0)])
            rate = draw.choice([None, None, draw.uniform(-50.0, 50.0)])
            wanted = law.step(r, y, dt, a, rate)
            out = pid.step(r, y, dt, a, rate)
            given = {name: getattr(out, name) for name in wanted}
            assert given == pytest.approx(wanted, rel=ROUNDING, abs=ROUNDING)
            assert out.saturated == (out.output != out.unsaturated)
            assert pid.i_term == out.i_term


@pytest.mark.parametrize("seed", range(4))
def test_gain_change_is_bumpless_through_the_integral(seed):
    draw = random.Random(seed)
    for _ in range(40):
        old, new = drawn_gains(draw), drawn_gains(draw)
        law, pid = Law(old), Pid(old)
        for _ in range(5):
            inputs = (
                draw.uniform(-5.0, 5.0),
                draw.uniform(-5.0, 5.0),
                0.01,
                draw.uniform(-9.0, 9.0),
            )
            law.step(*inputs, None)
            pid.step(*inputs)
        before = law.at_rest()
        pid.set_gains(new)
        law.g = new
        moved = law.integral + before - law.at_rest() if new.i else 0.0
        law.integral = clamp(moved, new.i_clamp_min, new.i_clamp_max)
        assert pid.i_term == pytest.approx(law.integral, rel=ROUNDING, abs=ROUNDING)
        assert pid.gains is new
        # The previous value of the next difference is weighted anew.
        law.before = new.setpoint_weight_d * law.seen[0] - law.seen[1]
        wanted = law.step(1.0, 0.5, 0.02, 0.0, None)
        out = pid.step(1.0, 0.5, 0.02)
        assert out.output == pytest.approx(wanted["output"], rel=ROUNDING, abs=ROUNDING)


def test_non_finite_input_gives_nan_output_and_leaves_state_unchanged():
    gains = PidGains(p=1.0, i=2.0, d=0.1, feedforward_acceleration=0.1)
    for bad in [(math.nan, 0.0, 0.01), (0.0, math.inf, 0.01), (0.0, 0.0, 0.01, -math.inf),
                (0.0, 0.0, 0.01, 0.0, math.nan), (0.0, 0.0, 0.01, 0.0, math.inf)]:  # fmt: skip
        pid, calm = Pid(gains), Pid(gains)
        pid.step(1.0, 0.2, 0.01)
        calm.step(1.0, 0.2, 0.01)
        refused = pid.step(*bad)
        others = (refused.output, refused.unsaturated, refused.p_term, refused.d_term,
                  refused.feedforward)  # fmt: skip
        assert all(math.isnan(value) for value in others)
        assert refused.i_term == calm.i_term and refused.saturated is False
        repeated = pid.step(1.0, 0.2, 0.0)
        assert math.isnan(repeated.output) and repeated.i_term == calm.i_term
        assert pid.step(1.0, 0.3, 0.01) == calm.step(1.0, 0.3, 0.01)


def test_overflow_leaves_integral_and_derivative_finite():
    pid = Pid(PidGains(p=0.0, i=1e9, d=0.0, u_clamp_min=-12.0, u_clamp_max=12.0))
    for sign in (1.0, -1.0):
        for _ in range(3):
            assert abs(pid.step(sign * 1e308, 0.0, 1.0).output) == 12.0 or pid.i_term == 0.0
            assert math.isfinite(pid.i_term)
    gains = {"u_clamp_min": -12.0, "u_clamp_max": 12.0, "derivative_filter_time_constant": 0.1}
    for sign in (1.0, -1.0):
        pid = Pid(PidGains(p=0.0, d=1.0, **gains))
        pid.step(0.0, 0.0, 0.1)
        assert pid.step(0.0, sign * 1e308, 1e-9).output == -sign * 12.0
        assert pid.step(0.0, sign * 1e308, 0.1).d_term == 0.0, "an overflowed rate is forgotten"


def test_output_is_zero_before_first_step_and_after_reset():
    out = Pid(PidGains(p=3.0, i=1.0)).step(9.0, 1.0, 0.0)
    assert out == (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False)
    pid = Pid(PidGains(p=3.0, i=1.0))
    pid.step(2.0, 1.0, 0.5)
    pid.reset(save_i_term=True)
    assert pid.i_term == 0.5 and pid.step(9.0, 1.0, 0.0) == (0.0, 0.0, 0.0, 0.5, 0.0, 0.0, False)
    pid.reset()
    assert pid.i_term == 0.0 and pid.step(9.0, 1.0, 0.0).i_term == 0.0


def test_gain_change_before_first_step_leaves_integral_at_zero():
    pid = Pid(PidGains(p=1.0, i=1.0))
    pid.set_gains(PidGains(p=5.0, i=1.0, setpoint_weight_d=1.0))
    assert pid.i_term == 0.0
    # The first difference assumes rest at the measurement: only the set-point term changes.
    assert pid.step(2.0, 1.0, 0.1).p_term == 5.0


def test_integral_gain_below_epsilon_counts_as_zero():
    for gain, grows in ((EPSILON, False), (-EPSILON, False), (3 * EPSILON, True)):
        gains = PidGains(p=0.0, i=gain, u_clamp_max=1.0, antiwindup_strategy="back_calculation",
                         tracking_time_constant=1.0, feedforward_velocity=1.0)  # fmt: skip
        pid = Pid(gains)
        pid.step(5.0, 0.0, 0.5)
        assert (pid.i_term != 0.0) is grows
    pid = Pid(PidGains(p=1.0, i=1.0))
    pid.step(1.0, 0.0, 1.0)
    pid.set_gains(PidGains(p=0.0, i=EPSILON))
    assert pid.i_term == 0.0


def test_default_tracking_time_constant_follows_astrom_and_hagglund():
    # Astrom and Hagglund: the square root of Ti Td, or Ti without derivative.
    cases = [({"p": 3.0, "i": 12.0}, 0.25), ({"p": 3.0, "i": 2.0, "d": 0.5}, 0.5),
             ({"p": 3.0, "i": 2.0, "d": 0.5, "tracking_time_constant": 7.0}, 7.0),
             ({"p": 3.0, "i": 0.0, "d": 0.5}, 0.0)]  # fmt: skip
    for gains, expected in cases:
        assert Pid(PidGains(**gains)).tracking_time_constant == pytest.approx(expected)


@pytest.mark.parametrize("name", ["u_clamp_min", "u_clamp_max", "i_clamp_min", "i_clamp_max"])
def test_clamps_may_be_infinite(name):
    value = -math.inf if name.endswith("min") else math.inf
    assert getattr(PidGains(**{name: value}), name) == value
    PidGains(i_clamp_min=0.0, i_clamp_max=0.0)


def test_unsupported_strategy_is_refused_with_its_replacement():
    with pytest.raises(ValueError, match="'legacy' is not offered: use 'none'"):
        PidGains(antiwindup_strategy="legacy")
    with pytest.raises(ValueError, match="must be one of none"):
        PidGains(antiwindup_strategy="always")


VOLTS = {"u_clamp_min": -12.0, "u_clamp_max": 12.0}


def settle(pid: Pid, reference: float, measurement: float, steps: int, dt: float = 0.01):
    for _ in range(steps):
        out = pid.step(reference, measurement, dt)
    return out


@pytest.mark.parametrize("strategy", ["back_calculation", "conditional_integration"])
def test_integral_does_not_wind_up_while_output_saturates(strategy):
    pid = Pid(PidGains(p=1.0, i=10.0, antiwindup_strategy=strategy, **VOLTS))
    out = settle(pid, 20.0, 0.0, 1000)
    assert out.saturated
    assert out.output == 12.0
    # Without anti-windup it would be i e t = 2000 V; the clamp allows at most 12 V.
    assert abs(out.i_term) <= 12.0


@pytest.mark.parametrize("p", [0.0, 2.0])
def test_back_calculation_with_zero_time_constant_stays_finite(p):
    pid = Pid(PidGains(p=p, i=3.0, antiwindup_strategy="back_calculation", **VOLTS))
    out = settle(pid, 50.0, 0.0, 500)
    assert math.isfinite(out.i_term)
    assert out.output == 12.0
    # The output leaves the clamp a few steps after the error changes sign: no windup.
    assert settle(pid, -50.0, 0.0, 20).output < 12.0


@pytest.mark.parametrize("dt", [-1e-3, -math.inf, math.nan, math.inf])
def test_invalid_time_step_is_refused_and_leaves_integral_unchanged(dt):
    pid = Pid(PidGains(p=1.0, i=2.0))
    settle(pid, 1.0, 0.0, 5)
    before = pid.i_term
    with pytest.raises(ParameterError, match="dt"):
        pid.step(1.0, 0.0, dt)
    assert pid.i_term == before


def test_time_step_of_zero_repeats_the_last_command():
    pid = Pid(PidGains(p=1.0, i=2.0))
    first = pid.step(1.0, 0.0, 0.1)
    assert pid.step(5.0, 0.0, 0.0) == first


def test_output_is_immutable():
    pid = Pid(PidGains(p=1.0))
    first = pid.step(1.0, 0.0, 0.1)
    pid.step(2.0, 0.0, 0.1)
    assert first.output == 1.0
    with pytest.raises(AttributeError):
        first.output = 3.0


finite = st.floats(-1e6, 1e6)
gain = st.floats(0.0, 1e3)


@given(
    p=gain, i=gain, d=gain,
    strategy=st.sampled_from(["none", "back_calculation", "conditional_integration"]),
    tracking=st.floats(0.0, 10.0),
    inputs=st.lists(st.tuples(finite, finite, st.floats(1e-4, 1.0), finite), max_size=20),
)  # fmt: skip
def test_output_is_clamped_and_the_integral_finite(p, i, d, strategy, tracking, inputs):
    gains = PidGains(p=p, i=i, d=d, antiwindup_strategy=strategy, tracking_time_constant=tracking,
                     feedforward_velocity=1.0, feedforward_static=1.0, **VOLTS)  # fmt: skip
    pid = Pid(gains)
    for reference, measurement, dt, acceleration in inputs:
        out = pid.step(reference, measurement, dt, acceleration)
        assert -12.0 <= out.output <= 12.0
        assert math.isfinite(out.i_term)
        assert out.saturated == (out.output != out.unsaturated)
