# SPDX-License-Identifier: Apache-2.0
"""Every case of test/data/conformance/diff_drive_cases.json, and the time-out of commands.

test/nodes/test_skid_steer.py holds the behaviour of the running node on time-outs, stamps and NaN.
"""

import json
import math
from pathlib import Path

import pytest

from smp_motor_control.body.command import BodyCommand, Verdict
from smp_motor_control.body.kinematics import SkidSteer
from smp_motor_control.body.odometry import Odometry
from smp_motor_control.body.speed_limiter import SpeedLimiter
from smp_motor_control.errors import ParameterError

FILE = Path(__file__).parent.parent / "data" / "conformance" / "diff_drive_cases.json"
CASES = json.loads(FILE.read_text(encoding="utf-8"))
ROUNDING = 1e-12


LIMITS = {
    "min_value": "min_velocity",
    "max_value": "max_velocity",
    "min_first_derivative_neg": "max_acceleration_reverse",
    "max_first_derivative_pos": "max_acceleration",
    "min_first_derivative_pos": "max_deceleration",
    "max_first_derivative_neg": "max_deceleration_reverse",
    "min_second_derivative": "min_jerk",
    "max_second_derivative": "max_jerk",
}
FUNCTIONS = {
    "limit": "limit",
    "limit_value": "limit_velocity",
    "limit_first_derivative": "limit_acceleration",
    "limit_second_derivative": "limit_jerk",
}
"""Names of control_toolbox's rate_limiter, and those of SpeedLimiter."""


def limiter_of(limits: dict[str, float | None]) -> SpeedLimiter:
    return SpeedLimiter(**{LIMITS[name]: limit for name, limit in limits.items()})


def cases(name: str):
    return pytest.mark.parametrize("case", CASES[name], ids=lambda case: case.get("id", ""))


@cases("rate_limiter_cases")
def test_rate_limiter_returns_limited_value_and_factor(case):
    limiter = limiter_of(case["limits"])
    arguments = [case[name] for name in ("v", "v0", "v1", "dt") if case[name] is not None]
    value, factor = getattr(limiter, FUNCTIONS[case["function"]])(*arguments)
    assert value == pytest.approx(case["expect_v"], abs=ROUNDING)
    assert factor == pytest.approx(case["expect_factor"], abs=ROUNDING)


@cases("rate_limiter_invalid")
def test_minimum_above_maximum_is_refused(case):
    with pytest.raises(ParameterError, match="minimum"):
        limiter_of(case["limits"])


@cases("rate_limiter_valid")
@pytest.mark.parametrize("absent", [None, math.nan])
def test_missing_limits_are_accepted(case, absent):
    limits = {name: absent if x is None else x for name, x in case["limits"].items()}
    assert math.isfinite(limiter_of(limits).limit(10.0, 0.0, 0.0, 0.1).value)


@cases("inverse_kinematics_cases")
def test_forward_and_inverse_kinematics_match_reference_cases(case):
    names = ("wheel_separation", "wheel_separation_multiplier", "wheel_radius",
             "left_wheel_radius_multiplier", "right_wheel_radius_multiplier")  # fmt: skip
    robot = SkidSteer(**{name: case[name] for name in names})
    left, right = robot.wheel_speeds(case["linear_x"], case["angular_z"])
    assert left == pytest.approx(case["expect_left"], abs=case["abs_tol"])
    assert right == pytest.approx(case["expect_right"], abs=case["abs_tol"])
    back = robot.body_velocity(left, right)
    assert back == pytest.approx((case["linear_x"], case["angular_z"]), abs=ROUNDING)


@pytest.mark.parametrize("case", CASES["linorobot_kinematics_cases"])
def test_wheel_speeds_are_limited_to_maximum(case):
    to_rpm = 30.0 / math.pi
    robot = SkidSteer(
        wheel_separation=case["track"],
        wheel_radius=case["wheel_diameter"] / 2.0,
        max_wheel_speed=case["max_rpm"] / to_rpm,
    )
    left, right = robot.limit_wheel_speeds(case["linear_x"], case["angular_z"])
    assert left * to_rpm == pytest.approx(case["expect_left_rpm"], abs=case["abs_tol"])
    assert right * to_rpm == pytest.approx(case["expect_right_rpm"], abs=case["abs_tol"])


def apply(odometry: Odometry, update: dict) -> bool | None:
    if update["type"] == "set_odometry":
        return odometry.set_odometry(update["x"], update["y"], update["heading"])
    if update["type"] == "open_loop":
        return odometry.update_open_loop(update["linear"], update["angular"], update["dt"])
    step = {
        "wheel_velocity": odometry.update_from_velocity,
        "wheel_position": odometry.update_from_position,
    }[update["type"]]
    return step(update["left"], update["right"], update["dt"])


@cases("odometry_cases")
def test_odometry_matches_reference_cases(case):
    names = ("wheel_separation", "left_radius", "right_radius", "window")
    odometry = Odometry(**{name: case[name] for name in names})
    expected = dict(case["expect"])
    if any(update["type"] == "wheel_position" for update in case["updates"]):
        if case["id"] == "first_position_offset_gotcha":
            # A known fault of diff_drive_controller: here the first reading adds no motion.
            assert not apply(odometry, case["updates"][0])
            assert odometry.x == 0.0
            return
        # The reference test assumes wheels at 0.
        odometry.update_from_position(0.0, 0.0, 1.0)
    for update in case["updates"]:
        for _ in range(update.get("repeat", 1)):
            result = apply(odometry, update)
            assert "expect_result" not in update or result is update["expect_result"]
    for name, value in expected.items():
        assert getattr(odometry, name) == pytest.approx(value, abs=case["abs_tol"]), name


def test_speed_limiter_reaches_target_at_the_expected_update():
    case = CASES["controller_speed_limiter"]
    prefix = "linear.x."
    limiter = SpeedLimiter(
        **{name.removeprefix(prefix): value for name, value in case["params"].items()}
    )
    robot = SkidSteer(wheel_separation=case["wheel_separation"], wheel_radius=case["wheel_radius"])
    v0 = v1 = 0.0
    for phase in case["phases"]:
        v0 = v1 = phase["from_v"]
        for update in range(1, phase["reached_on_update"] + 1):
            v0, v1 = limiter.limit(phase["command"], v0, v1, case["dt"]).value, v0
            left, right = robot.wheel_speeds(v0, 0.0)
            assert left == right
            reached = abs(left - phase["expect_wheel"]) <= phase["abs_tol"]
            assert reached == (update == phase["reached_on_update"]), update


def test_there_is_no_command_before_the_first_finite_one():
    command = BodyCommand()
    assert command.at(0.0) is None
    assert command.receive(math.nan, 0.0, 0.0, 0.0) is Verdict.NOT_FINITE
    assert command.at(0.0) is None


DRIVES, STOPS = (1.0, 0.0), (0.0, 0.0)


@pytest.mark.parametrize(
    ("timeout", "age", "verdict", "asked"),
    [
        (0.5, 0.0, Verdict.ACCEPTED, {10.5: DRIVES, 10.501: STOPS}),
        (0.0, 100.0, Verdict.ACCEPTED, {20.0: DRIVES}),  # no time-out
        (0.5, None, Verdict.ZERO_STAMP, {10.4: DRIVES}),
        (0.5, 0.499, Verdict.ACCEPTED, {10.0: DRIVES}),
        (0.5, 0.5, Verdict.STALE, {10.0: None}),
        (0.5, 3.0, Verdict.STALE, {10.0: None}),
        (0.5, 0.4, Verdict.ACCEPTED, {10.11: STOPS}),
        (0.5, -3600.0, Verdict.ACCEPTED, {10.51: STOPS}),  # a stamp from the future
    ],
)
def test_command_age_counts_towards_time_out(timeout, age, verdict, asked):
    command = BodyCommand(timeout)
    assert command.receive(*DRIVES, age, 10.0) is verdict
    assert {at: command.at(at) for at in asked} == asked
    command.receive(*DRIVES, 0.0, 11.0)
    assert command.at(11.0) == DRIVES


@pytest.mark.parametrize("bad", [(math.nan, 0.0), (0.0, math.inf), (-math.inf, math.nan)])
def test_non_finite_command_does_not_reset_the_time_out(bad):
    command = BodyCommand(0.5)
    command.receive(1.0, 0.5, 0.0, 10.0)
    for k in range(1, 11):
        assert command.receive(*bad, 0.0, 10.0 + 0.1 * k) is Verdict.NOT_FINITE
        expected = (1.0, 0.5) if k <= 5 else (0.0, 0.0)
        assert command.at(10.0 + 0.1 * k - 0.01) == expected


def test_reset_forgets_the_command():
    command = BodyCommand(0.5)
    command.receive(1.0, 0.5, 0.0, 10.0)
    command.reset()
    assert command.at(10.0) is None
