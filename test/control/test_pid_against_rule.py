# SPDX-License-Identifier: Apache-2.0
"""The PID against control_toolbox's published rule, on random gains and samples.

The rule is that of its class ``Pid`` (branch jazzy, commit 05de3c67): error in, command out,
the integral advanced after the command, a given rate of the error not remembered.
"""

import math
import random

import pytest

from smp_motor_control.pid import EPSILON, Pid, PidGains


class Rule:
    """The rule, written down for one degree of freedom and nothing else."""

    def __init__(self, gains: PidGains) -> None:
        self.gains = gains
        self.integral = self.last_error = self.command = 0.0
        self.tracking = gains.tracking_time_constant
        if self.tracking == 0.0 and gains.i > 0.0:
            self.tracking = math.sqrt(gains.d / gains.i) if gains.d > 0.0 else gains.p / gains.i

    def step(self, error: float, dt: float, rate: float | None) -> float:
        if dt == 0.0:
            return self.command
        if not math.isfinite(error):
            self.command = math.nan
            return self.command
        if rate is None:
            rate, self.last_error = (error - self.last_error) / dt, error
        g = self.gains
        wanted = g.p * error + self.integral + g.d * rate
        self.command = min(max(wanted, g.u_clamp_min), g.u_clamp_max)
        if abs(error) > g.error_deadband:
            self.integral += dt * self.growth(error, wanted)
        self.integral = min(max(self.integral, g.i_clamp_min), g.i_clamp_max)
        return self.command

    def growth(self, error: float, wanted: float) -> float:
        g, excess = self.gains, self.command - wanted
        if g.antiwindup_strategy == "back_calculation":
            return g.i * error + excess / self.tracking if g.i > 0.0 else 0.0
        winds_up = abs(excess) > EPSILON and error * wanted > 0.0
        if g.antiwindup_strategy == "conditional_integration" and winds_up:
            return 0.0
        return g.i * error


def random_gains(rng: random.Random) -> PidGains:
    def limit() -> float:
        return rng.choice([math.inf, rng.uniform(0.5, 24.0)])

    return PidGains(
        p=rng.uniform(0.01, 20.0),
        i=rng.choice([0.0, rng.uniform(0.1, 100.0)]),
        d=rng.choice([0.0, rng.uniform(0.001, 2.0)]),
        u_clamp_min=-limit(),
        u_clamp_max=limit(),
        i_clamp_min=-limit(),
        i_clamp_max=limit(),
        antiwindup_strategy=rng.choice(["none", "back_calculation", "conditional_integration"]),
        tracking_time_constant=rng.choice([0.0, rng.uniform(0.01, 1.0)]),
        error_deadband=rng.choice([EPSILON, 0.1, rng.uniform(0.0, 0.5)]),
        setpoint_weight_d=1.0,
    )


@pytest.mark.parametrize("seed", range(20))
def test_random_controllers_follow_the_rule_sample_by_sample(seed):
    rng = random.Random(seed)
    for _ in range(20):
        gains = random_gains(rng)
        rule, pid = Rule(gains), Pid(gains)
        for _ in range(40):
            error = rng.choice([rng.uniform(-5.0, 5.0), rng.uniform(-0.2, 0.2), 0.1, 0.0, math.nan])
            dt = rng.choice([0.01, 0.001, rng.uniform(1e-4, 0.1), 0.0])
            rate = rng.choice([None, None, rng.uniform(-50.0, 50.0)])
            wanted = rule.step(error, dt, rate)
            given = pid.step(error, 0.0, dt, error_rate=rate).output
            # Rounding alone: the terms are added in another order.
            assert given == pytest.approx(wanted, rel=1e-9, abs=1e-9, nan_ok=True)
            assert pid.i_term == pytest.approx(rule.integral, rel=1e-9, abs=1e-9)
