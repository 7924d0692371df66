"""tune --apply on four running wheels: real nodes, real plant, over DDS."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest
import rclpy
import yaml
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState

from smp_interfaces.msg import MotorState
from smp_motor_control import WHEELS

ROOT = Path(__file__).resolve().parents[2]
MOTORS = ROOT / "config" / "motors_paper.yaml"
SPEED = 1.2
"""Set-point of the wheels [rad/s], well within what the slowest of them reaches."""


class Robot:
    """Drives the running wheels at one speed and remembers what they did."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("test_apply")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.publisher = self.node.create_publisher(JointState, "/wheel_setpoints", 1)
        self.node.create_timer(0.05, self._drive)
        self.speeds: dict[str, list[tuple[float, float]]] = {wheel: [] for wheel in WHEELS}
        for wheel, seen in self.speeds.items():
            self.node.create_subscription(
                MotorState,
                f"/{wheel}/motor_state",
                lambda m, seen=seen: seen.append((time.monotonic(), m.velocity)),
                rclpy.qos.qos_profile_sensor_data,
            )

    def _drive(self) -> None:
        message = JointState(name=[f"{wheel}_wheel_joint" for wheel in WHEELS])
        message.velocity = [SPEED] * len(WHEELS)
        self.publisher.publish(message)

    def spin(self) -> None:
        self.executor.spin_once(timeout_sec=0.01)

    def mean_speed(self, wheel: str, seconds: float = 0.3) -> float:
        now = time.monotonic()
        recent = [v for t, v in self.speeds[wheel] if t > now - seconds]
        return sum(recent) / len(recent) if recent else 0.0

    def at_speed(self) -> bool:
        return all(abs(self.mean_speed(wheel) - SPEED) < 0.1 * SPEED for wheel in WHEELS)

    def gain(self, wheel: str, name: str = "p") -> float:
        client = self.node.create_client(GetParameters, f"/{wheel}/wheel_pid/get_parameters")
        assert client.wait_for_service(5.0)
        future = client.call_async(GetParameters.Request(names=[name]))
        self.executor.spin_until_future_complete(future, 5.0)
        return future.result().values[0].double_value

    def slowest_since(self, begin: float) -> float:
        """Least mean speed of any wheel over any tenth of a second since ``begin``."""
        least = SPEED
        for seen in self.speeds.values():
            values = [v for t, v in seen if t > begin]
            for k in range(0, len(values) - 20, 20):
                least = min(least, sum(values[k : k + 20]) / 20)
        return least


@pytest.fixture
def robot(process, eventually, tmp_path):
    gains = tmp_path / "start.yaml"
    tree = yaml.safe_load((ROOT / "config" / "gains.yaml").read_text())
    for node in tree.values():
        node["ros__parameters"].update(p=1.0, i=15.0, d=0.0)
    gains.write_text(yaml.safe_dump(tree))
    started = [process("motor_plant", "--ros-args", "-p", f"motors_file:={MOTORS}")]
    for wheel in WHEELS:
        ros = ("--ros-args", "-r", f"__ns:=/{wheel}", "--params-file", gains)
        started.append(process("wheel_pid", *ros))
    rclpy.init()
    one = Robot()
    try:
        eventually(
            one.at_speed,
            deadline=30.0,
            step=one.spin,
            message="\n".join(p.output for p in started),
        )
        yield one
    finally:
        one.node.destroy_node()
        rclpy.shutdown()


def run_tune(process, robot, *arguments):
    tune = process(sys.executable, "-m", "smp_motor_ident.commands.tune", *arguments)
    end = time.monotonic() + 150.0
    while tune.returncode is None and time.monotonic() < end:
        robot.spin()
    return tune.wait(1.0), tune.output


def test_apply_changes_four_running_wheels_without_a_stop(process, robot):
    begin = time.monotonic()
    code, output = run_tune(process, robot, MOTORS, "--rate", "200", "--apply")
    assert code == 0, output
    assert "kept" in output
    assert "1 -> " in output  # the difference was shown: p was 1
    for wheel in WHEELS:
        assert robot.gain(wheel) > 1.5
    # A stop would show as standstill; a bumpless change leaves the speed within the noise of
    # counts and the settling of the new loop, for which 20 % is generous.
    assert robot.slowest_since(begin) > 0.8 * SPEED


BAD = ({"p": 400.0, "i": 4000.0}, {"p": -2.0, "i": -40.0}, {"d": 5.0})
"""Unstable, of the wrong sign, and deaf from the noise of the counts."""


def test_bad_gains_are_taken_back_within_two_seconds(process, robot, eventually, tmp_path):
    gains = tmp_path / "bad.yaml"
    for bad in BAD:
        tree = {f"/{wheel}/wheel_pid": {"ros__parameters": bad} for wheel in WHEELS}
        gains.write_text(yaml.safe_dump(tree))
        code, output = run_tune(process, robot, "--gains", gains, "--apply")
        assert code == 1, output
        taken = output[output.index("taken back after") :].split()
        assert float(taken[3]) < 2.0
        for wheel in WHEELS:
            assert robot.gain(wheel, "p") == 1.0
            assert robot.gain(wheel, "i") == 15.0
        eventually(robot.at_speed, deadline=10.0, step=robot.spin, message="did not drive on")


def test_apply_without_running_wheels_says_so(process, ros_domain):
    tune = process(sys.executable, "-m", "smp_motor_ident.commands.tune", MOTORS, "--apply")
    assert tune.wait(150.0) == 1
    assert "is wheel_pid running?" in tune.output
    assert "Traceback" not in tune.output


def test_relay_on_a_running_wheel_gives_gains_without_a_model(process, robot, eventually, tmp_path):
    output = tmp_path / "relay.yaml"
    code, told = run_tune(
        process, robot, "--relay", "rear_right", "--supply", "12", "--output", output
    )
    assert code == 0, told
    gains = yaml.safe_load(output.read_text())["/rear_right/wheel_pid"]["ros__parameters"]
    # Ultimate point of the model at 200 Hz: Ku 25 V s/rad of the wheel without delay, 12 with 5 ms
    # and 4 with 20 ms, which a busy machine may add; Tyreus-Luyben takes a third.
    assert 0.8 < gains["p"] < 9.0
    assert 0.0 < gains["i"] < 20 * gains["p"]
    # The controller has the wheel again.
    eventually(robot.at_speed, deadline=15.0, step=robot.spin, message="did not drive on")
