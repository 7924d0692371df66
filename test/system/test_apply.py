# SPDX-License-Identifier: Apache-2.0
"""tune --apply on four running wheels: real nodes, real plant, over DDS."""

import math
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from processes import own_domain, processes
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from wheel_robot import spinning

from smp_interfaces.msg import MotorState
from smp_motor_control import WHEELS
from smp_motor_control.motor.file import load_motors
from smp_motor_control.nodes.executor import LeanExecutor
from smp_motor_ident.tune.methods.rules import RULES

ROOT = Path(__file__).resolve().parents[2]
MOTORS = ROOT / "config" / "motors_paper.yaml"
PERIOD = 1 / 200
"""Sample interval of the plant [s]."""

GAINS = {"p": 1.0, "i": 15.0, "d": 0.0}
SPEED = 1.2
"""Set-point of the wheels [rad/s], well within reach of the slowest."""


class Robot:
    """Drives the running wheels at one speed and stores their states."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("test_apply")
        self.publisher = self.node.create_publisher(JointState, "/wheel_setpoints", 1)
        self.node.create_timer(0.05, self._drive)
        self.speeds: dict[str, list[tuple[float, float]]] = {wheel: [] for wheel in WHEELS}
        self.readers, self.writers = {}, {}
        for wheel, seen in self.speeds.items():
            self.node.create_subscription(
                MotorState,
                f"/{wheel}/motor_state",
                lambda m, seen=seen: seen.append((time.monotonic(), m.velocity)),
                rclpy.qos.qos_profile_sensor_data,
            )
            name = f"/{wheel}/wheel_pid"
            self.readers[wheel] = self.node.create_client(GetParameters, f"{name}/get_parameters")
            self.writers[wheel] = self.node.create_client(SetParameters, f"{name}/set_parameters")
        self.executor = LeanExecutor()
        self.executor.add_node(self.node)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()

    def _drive(self) -> None:
        message = JointState(name=[f"{wheel}_wheel_joint" for wheel in WHEELS])
        message.velocity = [SPEED] * len(WHEELS)
        self.publisher.publish(message)

    def mean_speed(self, wheel: str, seconds: float = 0.3) -> float:
        now = time.monotonic()
        recent = [v for t, v in list(self.speeds[wheel]) if t > now - seconds]
        return sum(recent) / len(recent) if recent else 0.0

    def at_speed(self) -> bool:
        return all(abs(self.mean_speed(wheel) - SPEED) < 0.1 * SPEED for wheel in WHEELS)

    def gain(self, wheel: str, name: str = "p") -> float:
        request = GetParameters.Request(names=[name])
        return self._ask(self.readers[wheel], request).values[0].double_value

    def set_gains(self, wheel: str) -> None:
        parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in GAINS.items()
        ]
        results = self._ask(
            self.writers[wheel], SetParameters.Request(parameters=parameters)
        ).results
        assert all(one.successful for one in results), results

    def _ask(self, client, request):
        """Repeat a request until it is answered: one is lost while discovery is incomplete."""
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            answered = threading.Event()
            future = client.call_async(request)
            future.add_done_callback(lambda _, answered=answered: answered.set())
            if answered.wait(1.0):
                return future.result()
        pytest.fail(f"{client.srv_name} does not answer within 20 s")

    def slowest(self, begin: float, end: float) -> float:
        """Return the lowest mean speed of any wheel over any tenth of a second of an interval."""
        least = SPEED
        for seen in self.speeds.values():
            values = [v for t, v in list(seen) if begin < t < end]
            assert len(values) > 100, "too few states to tell"
            for k in range(0, len(values) - 20, 20):
                least = min(least, sum(values[k : k + 20]) / 20)
        return least


@pytest.fixture(scope="module", autouse=True)
def ros_domain():
    """Give all tests of this file one domain, in which their robot runs."""
    with own_domain() as domain:
        yield domain


@pytest.fixture(scope="module")
def running(ros_domain, eventually, tmp_path_factory):
    """Start the plant and four controllers, and drive."""
    folder = tmp_path_factory.mktemp("robot")
    gains = folder / "start.yaml"
    tree = yaml.safe_load((ROOT / "config" / "gains.yaml").read_text())
    for node in tree.values():
        # A machine that runs tests pauses at times: hold the voltage over a pause, so that only
        # the tested code can stop a wheel.
        node["ros__parameters"].update(**GAINS, feedback_timeout=2.0, setpoint_timeout=2.0)
    gains.write_text(yaml.safe_dump(tree))
    plant = ("-p", f"motors_file:={MOTORS}", "-p", "command_timeout:=2.0")
    ros = ("--ros-args", "--params-file", gains)
    with processes(folder) as process:
        started = [process("motor_plant", "--ros-args", *plant)]
        pids = {w: process("wheel_pid", *ros, "-r", f"__ns:=/{w}") for w in WHEELS}
        started.extend(pids.values())
        rclpy.init()
        one = Robot()
        one.processes = pids
        try:
            # In a thread, so that set-points continue while a test waits.
            with spinning(one.executor.spin_once):
                eventually(one.at_speed, 30.0, message="\n".join(p.output for p in started))
                yield one
        finally:
            one.close()
            rclpy.shutdown()


@pytest.fixture
def robot(running, eventually):
    """Return the running robot with the gains that it started with."""
    for wheel, process in running.processes.items():
        process.send_signal(signal.SIGCONT)
        running.set_gains(wheel)
    eventually(running.at_speed, deadline=30.0, message="does not drive")
    return running


TUNE = (sys.executable, "-m", "smp_motor_ident.cli.tune")


def run_tune(process, *arguments):
    tune = process(*TUNE, *arguments)
    return tune.wait(150.0), tune.output


def write_gains(path: Path, gains: dict[str, float]) -> None:
    tree = {f"/{wheel}/wheel_pid": {"ros__parameters": gains} for wheel in WHEELS}
    path.write_text(yaml.safe_dump(tree))


def begin_trial(process, robot, eventually, folder, seconds):
    """Apply other gains, and return the tool that supervises the trial."""
    write_gains(folder / "other.yaml", {"p": 1.1})
    tune = process(*TUNE, "--gains", folder / "other.yaml", "--apply", "--watch", seconds)
    for wheel in WHEELS:
        eventually(lambda wheel=wheel: robot.gain(wheel) == 1.1, 60.0, message=tune.output)
    return tune


BAD = ({"p": 400.0, "i": 4000.0}, {"p": -2.0, "i": -40.0}, {"d": 5.0})
"""Unstable gains, gains of the wrong sign, and a derivative gain saturated by count noise."""


def test_bad_gains_are_reverted_within_two_seconds(process, robot, eventually, tmp_path):
    gains = tmp_path / "bad.yaml"
    for bad in BAD:
        write_gains(gains, bad)
        code, output = run_tune(process, "--gains", gains, "--apply")
        assert code == 1, output
        taken = output[output.index("restored the old gains after") :].split()
        print(f"restored after {taken[5]} s")
        assert float(taken[5]) < 2.0
        for wheel in WHEELS:
            assert robot.gain(wheel, "p") == 1.0
            assert robot.gain(wheel, "i") == 15.0
        eventually(robot.at_speed, deadline=20.0, message="did not drive on")


def test_controller_suspended_in_trial_gets_old_gains_on_return(
    process, robot, eventually, tmp_path
):
    tune = begin_trial(process, robot, eventually, tmp_path, seconds=20)
    robot.processes["rear_left"].send_signal(signal.SIGSTOP)
    eventually(lambda: "rear_left does not answer" in tune.output, 30.0, message=tune.output)
    robot.processes["rear_left"].send_signal(signal.SIGCONT)
    assert tune.wait(60.0) == 1
    assert "rear_left is back and has its old gains" in tune.output
    assert [robot.gain(wheel) for wheel in WHEELS] == [1.0] * len(WHEELS)


def test_old_gains_are_restored_after_tool_is_killed(process, robot, eventually, tmp_path):
    tune = begin_trial(process, robot, eventually, tmp_path, seconds=60)
    tune.send_signal(signal.SIGKILL)
    for wheel in WHEELS:
        eventually(lambda wheel=wheel: robot.gain(wheel) == 1.0, deadline=10.0, message=wheel)


def test_apply_without_running_wheels_is_refused(process):
    with own_domain():
        code, output = run_tune(process, "--gains", ROOT / "config" / "gains.yaml", "--apply")
    assert code == 1
    assert "is wheel_pid running?" in output
    assert "Traceback" not in output


def ultimate_period(motor, delay: float) -> float:
    """Return the ultimate period of a motor with a delay [s]."""
    w = np.geomspace(1.0, 1e4, 20_000)
    phase = np.unwrap(-np.angle(motor.a0 + 1j * w * motor.a1 - w**2 * motor.a2)) - w * delay
    return float(2 * math.pi / w[np.argmax(phase < -math.pi)])


def test_relay_test_on_running_wheel_gives_gains_without_model(
    process, robot, eventually, tmp_path
):
    output = tmp_path / "relay.yaml"
    # Ten seconds hold enough cycles between the pauses of a busy machine.
    options = ("--supply", "12", "--relay-seconds", "10", "--output", output)
    code, said = run_tune(process, "--relay", "rear_right", *options)
    assert code == 0, said
    gains = yaml.safe_load(output.read_text())["/**/rear_right/wheel_pid"]["ros__parameters"]
    share, integral, _ = RULES["tyreus_luyben", "pi"]
    ultimate, period = gains["p"] / share, gains["p"] / gains["i"] / integral
    # Additional delay on a busy machine changes the period, and the ultimate gain with it: compare
    # with the motor's own response at that period. One part in ten is for the counts:
    # 2.5 rad/s of quantum on an amplitude of some 20 rad/s, over dozens of cycles.
    motor = load_motors(MOTORS)["rear_right"]
    m, w = motor.parameters, 2j * math.pi / period
    response = 1 / (m.a2 * w**2 + m.a1 * w + m.a0) / motor.gearbox.ratio
    assert ultimate * abs(response) == pytest.approx(1.0, rel=0.1)
    # The loop lags by at least one sample of latching, half of hold and half of averaging, so its
    # period exceeds the model's with these. It is shorter than with a delay of 0.2 s, at which
    # wheel_pid reports that feedback is lost.
    assert ultimate_period(m, 2 * PERIOD) / 1.15 < period < ultimate_period(m, 0.2)
    # The controller has the wheel again.
    eventually(robot.at_speed, deadline=20.0, message="did not drive on")


def test_apply_changes_gains_of_four_running_wheels_without_a_stop(process, robot, tmp_path):
    # Design first, so that the load of designing does not disturb the wheels during the change.
    # A machine that runs tests responds late at times: design gains for 20 ms.
    gains = tmp_path / "good.yaml"
    options = ("--delay", "0.02", "--speed-source", "measured", "--output", gains)
    code, output = run_tune(process, MOTORS, *options)
    assert code == 0, output
    begin = time.monotonic()
    code, output = run_tune(process, "--gains", gains, "--apply")
    end = time.monotonic()
    assert code == 0, output
    assert "kept" in output
    assert "1 -> " in output  # the difference was shown: p was 1
    for wheel in WHEELS:
        wanted = yaml.safe_load(gains.read_text())[f"/**/{wheel}/wheel_pid"]["ros__parameters"]
        assert wanted["p"] != 1.0
        assert robot.gain(wheel) == wanted["p"]
    # A stop would show as standstill; a bumpless change leaves the speed within the noise of
    # counts and the settling of the new loop, for which 20 % is generous.
    assert robot.slowest(begin, end) > 0.8 * SPEED
