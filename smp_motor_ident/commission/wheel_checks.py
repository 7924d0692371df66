# SPDX-License-Identifier: Apache-2.0
"""Check the wiring and description of a robot by a test of its wheels before excitation.

A ``refused`` finding stops a commissioning until the user repairs the fault or accepts it.  Each
check is a function of all wheels; :data:`CHECKS` lists them.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from smp_motor_ident.commission.wheel_test import Figures
from smp_motor_ident.finding import Finding, Severity
from smp_motor_ident.limits import (
    BREAKAWAY_COUNTS,
    MAX_DEAD_ZONE_SHARE,
    MAX_FEEDBACK_AGE,
    MAX_FRICTION_RATIO,
    MAX_GAIN_RATIO,
    MAX_SUPPLY_SHORTFALL,
    MIN_FEEDBACK_RATE,
    VELOCITY_TOLERANCE,
)
from smp_motor_ident.record import Hardware


@dataclass(frozen=True)
class Robot:
    """The robot under test."""

    figures: Mapping[str, Figures]  # by wheel
    hardware: Mapping[str, Hardware]  # as the robot describes itself
    # counts that every wheel turned while one was driven, by driven wheel
    moved: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    # motor speeds per volt, known from a motor file [rad/s/V]
    gains: Mapping[str, float] = field(default_factory=dict)
    ratios: Mapping[str, float] = field(default_factory=dict)  # known gear ratios
    battery: float = math.nan  # voltage that the battery reports [V]; NaN if it does not
    # by wheel the fault of the position that its driver reports, and its remedy
    positions: Mapping[str, str] = field(default_factory=dict)


Check = Callable[[Robot], Iterator[Finding]]


def feedback(robot: Robot) -> Iterator[Finding]:
    """Check that samples are frequent, with increasing stamps of this clock."""
    for wheel, one in robot.figures.items():
        if not one.rate >= MIN_FEEDBACK_RATE:
            yield Finding(
                "feedback_rate", "refused",
                f"{wheel}: motor_state comes {one.rate:.3g} times a second",
                {"wheel": wheel, "rate": one.rate, "least": MIN_FEEDBACK_RATE},
                "publish motor_state 100 times a second or more, stamped when it was sampled",
            )  # fmt: skip
        if abs(one.age) > MAX_FEEDBACK_AGE:
            yield Finding(
                "feedback_age", "refused",
                f"{wheel}: stamps of motor_state are {abs(one.age):.3g} s "
                f"{'old on arrival' if one.age > 0 else 'ahead of this clock'}",
                {"wheel": wheel, "age": one.age, "limit": MAX_FEEDBACK_AGE},
                "stamp when it is sampled, on a clock that is synchronised with this one (chrony), "
                "or run this tool with use_sim_time where the robot does",
            )  # fmt: skip
        if one.repeated:
            yield Finding(
                "repeated_stamps", "warning",
                f"{wheel}: {one.repeated} stamps do not increase",
                {"wheel": wheel, "stamps": one.repeated},
                "stamp every sample with the instant at which it was taken",
            )  # fmt: skip


def position(robot: Robot) -> Iterator[Finding]:
    """Check that odometry can use the positions."""
    for wheel, problem in robot.positions.items():
        if problem:
            yield Finding("position_unusable", "warning", f"{wheel}: {problem}", {"wheel": wheel})


def motion(robot: Robot) -> Iterator[Finding]:
    """Check that each command turns its wheel and no other, and not before."""
    for wheel, one in robot.figures.items():
        if one.at_rest > BREAKAWAY_COUNTS:
            yield Finding(
                "motion_at_zero_voltage", "refused",
                f"{wheel}: turned by {one.at_rest:.0f} counts under zero voltage",
                {"wheel": wheel, "counts": one.at_rest, "limit": BREAKAWAY_COUNTS},
                "see that nothing else drives or turns the wheel, and that the encoder counts "
                "only motion",
            )  # fmt: skip
        moved = robot.moved.get(wheel, {})
        others = [w for w, n in moved.items() if w != wheel and n > BREAKAWAY_COUNTS]
        own = moved.get(wheel, math.inf) > BREAKAWAY_COUNTS
        if others and not own:
            yield Finding(
                "crossed_wheels", "refused",
                f"{wheel}: commanding it turns {', '.join(others)} instead",
                {"wheel": wheel, "counts": max(moved[w] for w in others)},
                "motors or encoders of these wheels are exchanged: swap their plugs, or their "
                "names in the driver",
            )  # fmt: skip
        elif not own or math.isnan(one.breakaway):
            yield _motionless(wheel, one)
        elif others:
            yield Finding(
                "coupled_wheels", "warning",
                f"{wheel}: {', '.join(others)} turned with it",
                {"wheel": wheel, "counts": max(moved[w] for w in others)},
                "lift the robot so that every wheel is free; wheels that a belt couples are one "
                "motor's load, commission one of them with --wheel",
            )  # fmt: skip


def _motionless(wheel: str, one: Figures) -> Finding:
    arrived = one.applied > 0.5
    where = (
        "the driver reports the voltage: check the motor's leads, the encoder's plug and whether "
        "something blocks the wheel"
        if arrived
        else "the driver does not report the voltage: check its supply, enable input and fuse"
    )
    return Finding(
        "no_motion", "refused",
        f"{wheel}: did not turn in both directions at up to {one.level:.3g} V",
        {"wheel": wheel, "voltage": one.level, "applied": _known(one.applied)},
        f"{where}; or allow more with --amplitude",
    )  # fmt: skip


def signs(robot: Robot) -> Iterator[Finding]:
    """Check that positive voltage increases the counts and is reported as positive."""
    for wheel, one in robot.figures.items():
        if one.applied < 0:
            yield Finding(
                "reported_voltage_sign", "refused",
                f"{wheel}: the driver reports {one.applied:.2f} times the commanded voltage",
                {"wheel": wheel, "applied": one.applied},
                "change the sign of the command or of the reported voltage in the driver",
            )  # fmt: skip
        if one.direction < 0:
            yield Finding(
                "reversed", "refused",
                f"{wheel}: positive voltage decreases its counts: the encoder's channels A and B "
                "or the motor's leads are swapped, which this test cannot tell",
                {"wheel": wheel, "direction": one.direction},
                "look at the wheel under positive voltage: if it turns forward, swap the encoder's "
                "channels (or change the sign of counts, position and velocity in the driver); if "
                "it turns backward, swap the motor's leads (or change the sign of its command "
                "and voltage)",
            )  # fmt: skip
        if one.velocity_ratio < 0:
            yield Finding(
                "velocity_sign", "refused",
                f"{wheel}: velocity and encoder_count have opposite signs",
                {"wheel": wheel, "ratio": one.velocity_ratio},
                "give both the same sign in the driver",
            )  # fmt: skip


def gear_ratio(robot: Robot) -> Iterator[Finding]:
    """Check gear ratio and counts per revolution against all available data."""
    blind = []
    for wheel, one in robot.figures.items():
        described, known = robot.hardware[wheel], robot.ratios.get(wheel, math.nan)
        ratio = abs(one.velocity_ratio)
        gain = one.gain / robot.gains.get(wheel, math.nan)
        stated = f"gear_ratio {described.gear_ratio:g}"
        if abs(ratio - 1.0) > VELOCITY_TOLERANCE:
            yield Finding(
                "gear_ratio", "refused",
                f"{wheel}: reported velocity is {ratio:.3g} times what counts show with {stated} "
                f"and {described.counts_per_revolution or 0:g} counts per revolution",
                {"wheel": wheel, "ratio": ratio, "described": described.gear_ratio},
                f"one of these numbers is wrong in motor_description or in the driver; with the "
                f"driver's a gear ratio of {described.gear_ratio / ratio:.4g} would fit",
            )  # fmt: skip
        if abs(known / described.gear_ratio - 1.0) > VELOCITY_TOLERANCE:
            yield Finding(
                "gear_ratio", "refused",
                f"{wheel}: motor_description has {stated}, the motor file {known:g}",
                {"wheel": wheel, "described": described.gear_ratio, "known": known},
                "correct the one that is wrong",
            )  # fmt: skip
        if abs(math.log(gain)) > math.log(MAX_GAIN_RATIO) if gain > 0 else False:
            yield Finding(
                "unexpected_gain", "refused",
                f"{wheel}: turns at {gain:.3g} times the speed per volt that the motor file has",
                {"wheel": wheel, "gain": one.gain, "expected": robot.gains[wheel]},
                "it is another motor, or counts_per_revolution is wrong (at the motor shaft, four "
                "counts a line); --accept unexpected_gain where it is meant to differ",
            )  # fmt: skip
        if math.isnan(known):
            blind.append(wheel)
    if blind:
        yield Finding(
            "gear_ratio_unknown", "note",
            f"{', '.join(blind)}: the gear ratio cannot be verified: motors are identified at "
            "their own shaft, but every speed of a wheel scales with it",
            {},
            "turn a wheel once by hand and check that position grows by 6.28 rad, or give the "
            "motors' data sheet with --motors",
        )  # fmt: skip


def dead_zone(robot: Robot) -> Iterator[Finding]:
    """Check that breaking away needs little more voltage than turning slowly."""
    for wheel, one in robot.figures.items():
        supply = robot.hardware[wheel].supply_voltage or 12.0
        beyond = one.breakaway - max(one.friction, 0.0)
        if beyond > MAX_DEAD_ZONE_SHARE * supply:
            yield Finding(
                "dead_zone", "warning",
                f"{wheel}: starts to turn at {one.breakaway:.2f} V and keeps turning at "
                f"{max(one.friction, 0.0):.2f} V: a dead zone of its driver, or a gearbox that "
                "sticks",
                {"wheel": wheel, "breakaway": one.breakaway, "friction": one.friction},
                "a wheel will hesitate wherever it starts or reverses: switch the driver to "
                "another PWM frequency or mode, or oil the gearbox",
            )  # fmt: skip


def supply(robot: Robot) -> Iterator[Finding]:
    """Check that the motors get the commanded voltage."""
    for wheel, one in robot.figures.items():
        nominal = robot.hardware[wheel].supply_voltage or math.nan
        if one.applied == 0.0 and one.direction:
            yield Finding(
                "voltage_not_reported", "refused",
                f"{wheel}: turns, but motor_state reports no voltage",
                {"wheel": wheel, "applied": one.applied},
                "publish the mean voltage of the interval before the stamp, duty cycle times "
                "supply where nothing measures it",
            )  # fmt: skip
        if 0 < one.applied < 1.0 - MAX_SUPPLY_SHORTFALL:
            yield Finding(
                "supply_low", "refused",
                f"{wheel}: gets {100 * one.applied:.0f} % of the commanded voltage, as from a "
                f"battery of {one.applied * nominal:.3g} V in place of {nominal:g} V",
                {"wheel": wheel, "applied": one.applied, "nominal": _known(nominal)},
                "charge or change the battery, or correct supply_voltage in motor_description",
            )  # fmt: skip
    rated = max((h.supply_voltage or math.nan for h in robot.hardware.values()), default=math.nan)
    if robot.battery < (1.0 - MAX_SUPPLY_SHORTFALL) * rated:
        yield Finding(
            "supply_low", "refused",
            f"battery_state says {robot.battery:.3g} V, motor_description {rated:g} V",
            {"battery": robot.battery, "nominal": rated},
            "charge or change the battery, or correct supply_voltage in motor_description",
        )  # fmt: skip


def compare_wheels(robot: Robot) -> Iterator[Finding]:
    """Check that no wheel has far more friction than the others; warn of longer coasting.

    A dragging wheel heats its motor and pulls the robot aside.  A different time constant is no
    obstacle to identification and tuning.
    """
    figures = robot.figures
    # Without a known friction, the breakaway voltage is its upper bound.
    drag = {w: one.friction if one.friction > 0 else one.breakaway for w, one in figures.items()}
    yield from _compare_with_others(
        drag, ("friction_outlier", "refused"),
        "friction", "it drags, brakes, or is another motor",
        "turn it by hand and compare it with the others; free it where it rubs or touches the "
        "ground. Give --accept friction_outlier if it is meant to differ",
    )  # fmt: skip
    yield from _compare_with_others(
        {w: one.coast for w, one in figures.items()}, ("coasts_longer", "warning"),
        "time to come to rest", "it carries something, touches the ground, or is another motor",
        "check that it is off the ground and carries nothing",
    )  # fmt: skip


def _compare_with_others(
    values: Mapping[str, float], code: tuple[str, Severity], what: str, why: str, advice: str
) -> Iterator[Finding]:
    """Return a finding for each wheel that exceeds the median of the others too far."""
    known = {w: v for w, v in values.items() if v > 0}
    for wheel, value in known.items():
        others = [v for w, v in known.items() if w != wheel]
        usual = float(np.median(others)) if len(others) > 1 else math.nan
        if value > MAX_FRICTION_RATIO * usual:
            text = f"{wheel}: its {what} is {value / usual:.3g} times that of the others: {why}"
            yield Finding(*code, text, {"wheel": wheel, "value": value, "median": usual}, advice)


CHECKS: tuple[Check, ...] = (
    feedback, position, motion, signs, gear_ratio, dead_zone, supply, compare_wheels,
)  # fmt: skip
"""All checks, the most basic first."""


def judge(robot: Robot) -> list[Finding]:
    """Return the findings of all checks."""
    return [finding for check in CHECKS for finding in check(robot)]


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
