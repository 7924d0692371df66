# SPDX-License-Identifier: Apache-2.0
"""commission on a running robot, as its user runs it."""

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from wheel_robot import WheelRobot

from smp_motor_control import WHEELS
from smp_motor_ident.report.document import read_identification

Process = Callable[..., Any]
ROOT = Path(__file__).resolve().parents[2]


TWO = ("front_left", "rear_left")

BUSY = (
    "feedback_rate", "feedback_age", "unreliable_identification", "validation_run",
    "verification", "verification_disturbed",
)  # fmt: skip
"""Findings that a busy machine may cause."""


def test_commission_checks_identifies_tunes_drives_and_applies_later(
    process, ros_domain, eventually, tmp_path
):
    space = ("--ros-args", "-r", "__ns:=/robot1")
    paper = yaml.safe_load((ROOT / "config" / "motors_paper.yaml").read_text())
    motors = paper["/**/motor_plant"]["ros__parameters"]["motors"]
    for wheel in set(motors) - set(TWO):
        del motors[wheel]
    (tmp_path / "motors.yaml").write_text(yaml.safe_dump(paper))
    process("motor_plant", *space, "-p", f"motors_file:={tmp_path / 'motors.yaml'}")
    robot = WheelRobot(ros_domain, "/robot1")
    try:
        eventually(lambda: all(robot.states[w] for w in TWO), 60.0, robot.spin, "no robot")
        accepted = [part for code in BUSY for part in ("--accept", code)]
        chosen = [part for wheel in TWO for part in ("--wheel", wheel)]
        tool = process(
            "commission", "--output", "r", "--duration", "3", "--yes", "--motors", "motors.yaml",
            *chosen, *accepted, *space,
        )  # fmt: skip
        assert tool.wait(600.0) == 0, tool.output
        begin = tool.output.index("no wheel_pid runs for front_left, rear_left")
        assert begin < tool.output.index("checking front_left")  # reported before anything moves
        estimates = read_identification(tmp_path / "r" / "identification")
        assert set(estimates) == set(TWO)
        # Motor 1 of Table 1; short signals on a busy machine still tell it to a percent.
        assert estimates["front_left"].value("dc_gain") == pytest.approx(25.548, rel=0.01)
        assert (tmp_path / "r" / "gains.yaml").is_file()
        document = json.loads((tmp_path / "r" / "commissioning.json").read_text())
        assert document["passed"]
        # Every wheel was checked, judged by a run of its own, and driven forward and in reverse.
        assert set(document["checks"]) == set(TWO)
        codes = [f["code"] for f in document["findings"]]
        assert codes.count("validation_run") == len(TWO) and "gear_ratio_unknown" not in codes
        assert [one["name"] for one in document["changes"]] == ["forward", "reverse"] * len(TWO)
        # Its controllers have ended with the tool, and completed steps are not repeated.
        counted = robot.node.count_publishers
        commands = [f"/robot1/{wheel}/motor_command" for wheel in TWO]
        eventually(lambda: not any(map(counted, commands)), 30.0, robot.spin)
        again = process("commission", "--output", "r", "--yes", "--resume", *space)
        assert again.wait(60.0) == 0, again.output
        assert "nothing is left to do" in again.output
        # Controllers that run get the gains after one more drive, and nothing else is repeated.
        for wheel in TWO:
            process("wheel_pid", "--ros-args", "-r", f"__ns:=/robot1/{wheel}")
        eventually(lambda: all(map(counted, commands)), 30.0, robot.spin)
        applied = process("commission", "--output", "r", "--yes", "--resume", "--apply",
                          *accepted, *space)  # fmt: skip
        assert applied.wait(120.0) == 0, applied.output
        assert "[1/1] driving" in applied.output
        # They were inactive meanwhile, and run again with the new gains.
        for _ in range(100):
            robot.send_setpoint(1.0)
            robot.spin_for(0.02)
        assert robot.velocity("front_left") == pytest.approx(1.0, abs=0.1)
    finally:
        robot.close()


def test_two_publishers_on_one_topic_are_reported_before_motion(
    process, robot, eventually, tmp_path
):
    process("motor_plant")
    process("motor_plant", "--ros-args", "-r", "__node:=forgotten_plant")
    count = robot.node.count_publishers
    eventually(lambda: count("/rear_left/motor_state") == 2, 30.0, robot.spin, "no robots")
    tool = process("commission", "--output", "r", "--yes", "--wheel", "rear_left")
    assert tool.wait(120.0) == 1, tool.output
    assert "/forgotten_plant and /motor_plant" in tool.output
    assert all(abs(state.voltage) < 1e-9 for state in robot.states["rear_left"])
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("name", ["SIGKILL", "SIGTSTP"])
def test_a_killed_or_suspended_commission_restores_the_controllers(
    process, robot, eventually, name
):
    process("motor_plant")
    gains = ("-p", "p:=2.0", "-p", "i:=40.0")
    process("wheel_pid", "--ros-args", "-r", "__ns:=/rear_left", *gains)
    eventually(lambda: robot.states["rear_left"], 30.0, robot.spin, "no robot")
    tool = process("commission", "--output", "r", "--wheel", "rear_left", "--yes")
    eventually(
        lambda: abs(robot.states["rear_left"][-1].voltage) > 1.0, 60.0, robot.spin, tool.output
    )
    tool.send_signal(getattr(signal, name))

    def follows() -> bool:
        robot.send_setpoint(1.0)
        robot.spin()
        return abs(robot.velocity("rear_left") - 1.0) < 0.1

    eventually(follows, 15.0, robot.spin, "the controller is not active again")


def test_nothing_moves_without_confirmation(process, robot, eventually, tmp_path):
    process("motor_plant")
    eventually(lambda: all(robot.states[w] for w in WHEELS), 30.0, robot.spin, "no robot")
    tool = process("commission", "--output", "r")
    assert tool.wait(60.0) == 2
    assert "--yes" in tool.output
    robot.spin_for(0.2)
    assert all(robot.states[w][-1].encoder_count == 0 for w in WHEELS)
    assert not (tmp_path / "r").exists()


def test_missing_robot_is_reported(process, tmp_path):
    tool = process("commission", "--output", "r", "--yes", "--wheel", "rear_left")
    assert tool.wait(60.0) == 1
    assert "/rear_left/motor_state" in tool.output
    assert "Traceback" not in tool.output
    assert not (tmp_path / "r").exists()
