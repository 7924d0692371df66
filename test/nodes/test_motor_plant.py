# SPDX-License-Identifier: Apache-2.0
"""motor_plant as its own process."""

import math
import signal
import time
from pathlib import Path

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from smp_interfaces.msg import MotorCommand, MotorDescription

PAPER = Path(__file__).parents[2] / "config" / "motors_paper.yaml"


def test_plant_follows_commands_times_out_and_publishes_description(process, robot, eventually):
    plant = process("motor_plant", "--ros-args", "-p", "rate:=100.0")
    front, idle = robot.states["front_left"], robot.states["rear_right"]
    eventually(lambda: len(front) > 20, 20.0, robot.spin, "no feedback")
    assert all(m.voltage == 0.0 and m.encoder_count == 0 for m in front)

    described: list[MotorDescription] = []
    late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot.node.create_subscription(
        MotorDescription, "/front_left/motor_description", described.append, late
    )
    eventually(lambda: described, 10.0, robot.spin, "no description for the late")
    assert described[0].gear_ratio == 65.5 and described[0].resistance == 12.919
    assert described[0].joint_name == front[-1].header.frame_id == "front_left_wheel_joint"

    send = robot.node.create_publisher(MotorCommand, "/front_left/motor_command", 10)
    eventually(lambda: send.get_subscription_count(), 10.0, robot.spin)

    def command(voltage: float, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            send.publish(MotorCommand(voltage=voltage))
            robot.spin()

    eventually(lambda: front[-1].voltage > 5.9, 10.0, lambda: command(6.0, 0.1), "not heard")
    command(6.0, 1.0)
    # Steady state of Table 1 with 0.45 V of friction: 2.17 rad/s; one count of speed is 0.02.
    assert robot.velocity("front_left") == pytest.approx(2.165, abs=0.05)
    assert front[-1].voltage == pytest.approx(6.0, abs=0.013)  # half a step of the PWM
    assert front[-1].position == pytest.approx(
        front[-1].encoder_count * 2 * math.pi / 500 / 65.5, abs=1e-9
    )
    assert idle[-1].encoder_count == 0

    eventually(lambda: front[-1].voltage == 0.0, 5.0, lambda: command(math.nan, 0.1))
    eventually(lambda: robot.named("motor_plant", "non-finite messages"), 3.0, robot.spin)
    command(6.0, 0.5)
    before = time.monotonic()
    eventually(lambda: front[-1].voltage == 0.0, 2.0, robot.spin, "no time-out")
    assert time.monotonic() - before < 1.0  # 0.2 s of time-out, and a busy machine

    accepted, reason = robot.set("motor_plant", command_timeout=-1.0)
    assert not accepted and "command_timeout" in reason
    plant.send_signal(signal.SIGTERM)
    assert plant.wait(2.0) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("inertia: 1.13e-06", "inertia: -1.13e-06"), "inertia is -1.13e-06"),
        (("inertia: 1.13e-06", "mass: 1.0"), "unknown key 'mass'"),
    ],
)
@pytest.mark.parametrize("way", ["motors_file", "params-file"])
def test_invalid_motor_file_ends_plant_with_one_line(process, tmp_path, change, words, way):
    path = tmp_path / "bad.yaml"
    path.write_text(PAPER.read_text().replace(*change))
    given = ["-p", f"motors_file:={path}"] if way == "motors_file" else ["--params-file", path]
    plant = process("motor_plant", "--ros-args", *given)
    assert plant.wait(15.0) == 2
    assert words in plant.output and len(plant.output.strip().splitlines()) == 1


def test_wheel_obeys_one_writer_until_its_lease_ends(process, robot, eventually):
    process("motor_plant", "--ros-args", "-p", "rate:=100.0")
    front = robot.states["front_left"]
    eventually(lambda: len(front) > 20, 20.0, robot.spin, "no feedback")
    owners: list[str] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot.node.create_subscription(
        String, "/front_left/motor_owner", lambda m: owners.append(m.data), latched
    )
    send = robot.node.create_publisher(MotorCommand, "/front_left/motor_command", 10)
    eventually(lambda: send.get_subscription_count() and owners, 10.0, robot.spin)

    def command(seconds: float = 0.6, **voltages: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for name, voltage in voltages.items():
                message = MotorCommand(voltage=voltage)
                message.header.frame_id = name
                send.publish(message)
            robot.spin()

    eventually(lambda: front[-1].voltage > 5.9, 10.0, lambda: command(0.1, first=6.0), "not heard")
    command(first=6.0, second=-6.0, third=0.0)
    # All six tenths of a second at 6 V, to half a step of the PWM.
    assert min(m.voltage for m in front[-20:]) > 5.98
    assert owners[-1] == "first"
    eventually(lambda: robot.named("motor_plant", "another node owns the wheel"), 3.0, robot.spin)
    command(first=0.0, second=-6.0)
    assert owners[-1] == "second" and front[-1].voltage == pytest.approx(-6.0, abs=0.013)
    eventually(lambda: owners[-1] == "", 3.0, robot.spin, "the lease does not end")
