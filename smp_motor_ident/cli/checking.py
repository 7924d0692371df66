# SPDX-License-Identifier: Apache-2.0
"""Test every wheel briefly at the beginning of ``commission``."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from smp_motor_control.motor.file import MotorEntry
from smp_motor_control.wheel.protection import Bounds
from smp_motor_ident.bag.read import convert_description
from smp_motor_ident.commission import wheel_test as judged
from smp_motor_ident.commission.wheel_checks import Robot, judge
from smp_motor_ident.commission.wheel_test import (
    Figures,
    Phase,
    Trace,
    has_settled,
    responds_clearly,
)
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Hardware

REST_S, COAST_S = 0.3, 0.4  # zero voltage before and after [s]; a coast of a few time constants
MAX_HOLD_S = 2.0  # longest time for which a voltage is held [s]
RAMP_RATE = 0.15  # rate of the voltage ramp, relative to the supply [1/s]
LEVEL_RATIO = 2.0  # ratio of successive voltage levels
FIRST_LEVEL = (1.5, 0.05)
"""First level: multiple of the starting voltage, plus a share of the supply."""

TIMEOUT_S = 5.0  # longest wait for descriptions [s]
TURNING_COUNTS = 12.0  # counts after which a ramp ends: the wheel turns


@dataclass(frozen=True)
class CheckResult:
    """Result of the wheel checks."""

    findings: tuple[Finding, ...]  # in the order of the checks
    figures: Mapping[str, Figures]  # by wheel
    amplitude: float  # voltage at which every wheel responds well, within the limit [V]
    speed: float  # of the fastest wheel at that voltage [rad/s]; NaN if unknown


@dataclass
class _WheelUnderTest:
    """One wheel of a running test, with its completed phases."""

    test: Any
    wheel: str
    supply: float
    limit: float
    phases: list[Phase] = field(default_factory=list)

    def phase(self, kind: Any, law: Callable[..., float], duration: float, until: Any) -> float:
        """Drive for a while; return the last voltage."""
        number = self.test.run({self.wheel: law}, duration, until)
        level = float(self.test.commands[self.wheel])
        self.phases.append(Phase(self.wheel, number, kind, level))
        return level

    def test_direction(self, sign: float) -> None:
        """Ramp until it turns, then hold growing levels until it answers well, then coast."""
        tape = self.test.recordings[self.wheel]
        rate, first = RAMP_RATE * self.supply, len(tape.rows)
        start = self.phase(
            "ramp",
            lambda t, _: sign * min(rate * t, self.limit),
            self.limit / rate,
            lambda: tape.turned(first) >= TURNING_COUNTS,
        )
        # At least two levels are needed to separate friction and gain.
        level = FIRST_LEVEL[0] * abs(start) + FIRST_LEVEL[1] * self.supply
        level = min(level, 0.5 * (abs(start) + self.limit))
        while tape.turned(first) >= TURNING_COUNTS:
            before = len(tape.rows)
            self._hold(sign * level)
            if level >= self.limit or responds_clearly(level, abs(start), tape.turned(before)):
                break
            level = min(LEVEL_RATIO * level, self.limit)
        self.phase("coast", lambda *_: 0.0, COAST_S, None)

    def _hold(self, voltage: float) -> None:
        """Hold a voltage until the wheel has settled."""
        rows = self.test.recordings[self.wheel].rows
        since = len(rows)
        self.phase(
            "hold", lambda *_: voltage, MAX_HOLD_S, lambda: has_settled(Trace.of(rows[since:]))
        )


def check_wheels(
    client: Any,
    wheels: Sequence[str],
    limit: float,
    bounds: Bounds,
    known: Mapping[str, MotorEntry],
    say: Callable[[str], None],
) -> CheckResult:
    """Test the wheels one by one, at most at ``limit`` volts, and check their responses."""
    from smp_motor_control.nodes import wheel_test

    described = wheel_test.read_descriptions(client, wheels, TIMEOUT_S)
    hardware = {
        wheel: convert_description(described[wheel]) if wheel in described else Hardware()
        for wheel in wheels
    }
    phases: list[Phase] = []
    counters = {wheel: wheel_test.make_counter(one) for wheel, one in hardware.items()}
    with wheel_test.WheelTest(client, counters, bounds).open() as test:
        for wheel in wheels:
            say(wheel)
            way = _WheelUnderTest(test, wheel, hardware[wheel].supply_voltage or 12.0, limit)
            way.phase("rest", lambda *_: 0.0, REST_S, None)
            way.test_direction(1.0)
            way.test_direction(-1.0)
            phases += way.phases
    traces = {wheel: Trace.of(tape.rows) for wheel, tape in test.recordings.items()}
    found = {
        wheel: judged.figures(
            traces[wheel], [p for p in phases if p.wheel == wheel], hardware[wheel]
        )
        for wheel in wheels
    }
    robot = Robot(
        found,
        hardware,
        judged.count_coupled_motion(traces, phases),
        {w: known[w].parameters.dc_gain for w in wheels if w in known},
        {w: known[w].gearbox.ratio for w in wheels if w in known},
        wheel_test.read_battery(client),
        {wheel: tape.position_problem() for wheel, tape in test.recordings.items()},
    )
    levels = [one.level for one in found.values() if math.isfinite(one.level)]
    amplitude = max(levels, default=limit)
    speeds = [abs(found[w].gain) * amplitude / hardware[w].gear_ratio for w in wheels]
    fastest = max(filter(math.isfinite, speeds), default=math.nan)
    return CheckResult(tuple(judge(robot)), found, amplitude, fastest)
