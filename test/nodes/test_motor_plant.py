# SPDX-License-Identifier: Apache-2.0
"""motor_plant, and the nodes that excite and identify its motors, as processes."""

import math
import signal
import time
from pathlib import Path

import pytest
from std_msgs.msg import String

from smp_interfaces.msg import MotorCommand, MotorDescription, MotorParameters

PAPER = Path(__file__).parents[2] / "config" / "motors_paper.yaml"


def test_plant_follows_commands_times_out_and_publishes_description(process, robot, eventually):
    plant = process("motor_plant", "--ros-args", "-p", "rate:=100.0")
    front, idle = robot.states["front_left"], robot.states["rear_right"]
    eventually(lambda: len(front) > 20, 20.0, robot.spin, "no feedback")
    assert all(m.voltage == 0.0 and m.encoder_count == 0 for m in front)

    described = robot.hear("/front_left/motor_description", MotorDescription)
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
    owners = robot.hear("/front_left/motor_owner", String)
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
    assert owners[-1].data == "first"
    eventually(lambda: robot.named("motor_plant", "another node owns the wheel"), 3.0, robot.spin)
    command(first=0.0, second=-6.0)
    assert owners[-1].data == "second" and front[-1].voltage == pytest.approx(-6.0, abs=0.013)
    eventually(lambda: owners[-1].data == "", 3.0, robot.spin, "the lease does not end")


def test_excite_stays_within_amplitude_and_ends_at_zero_volts(process, robot, eventually):
    process("motor_plant", "--ros-args", "-p", "rate:=100.0")
    eventually(lambda: robot.states["front_left"], 20.0, robot.spin)
    excite = process(
        "excite", "--ros-args", "-p", "signal:=fourier", "-p", "amplitude:=5.0",
        "-p", "duration:=5.0", "-p", "rate:=100.0", "-p", "wheels:=[front_left, rear_right]",
    )  # fmt: skip
    eventually(lambda: excite.returncode is not None, 20.0, robot.spin, excite.output)
    assert excite.wait(1.0) == 0
    for wheel in ("front_left", "rear_right"):
        last = robot.commands[wheel]
        eventually(lambda c=last: c[-1].voltage == 0.0, 3.0, robot.spin, "no zero command")
    one, two = ([m.voltage for m in robot.commands[w]] for w in ("front_left", "rear_right"))
    # 500 are sent; discovery may take seconds, and a busy machine skips some.
    assert len(one) > 60 and max(map(abs, one)) <= 5.0 and max(map(abs, one)) > 2.0
    assert one[20:60] != two[20:60]
    assert not robot.commands["front_right"]

    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP"):
        robot.commands["front_left"].clear()
        excite = process("excite", "--ros-args", "-p", "signal:=square", "-p", "duration:=60.0")
        eventually(lambda: len(robot.commands["front_left"]) > 20, 20.0, robot.spin)
        excite.send_signal(getattr(signal, name))
        assert excite.wait(2.0) == 0
        last = robot.commands["front_left"]
        eventually(lambda c=last: c[-1].voltage == 0.0, 3.0, robot.spin, "no zero command")


def test_excite_refuses_a_wheel_driven_by_another_node(process, robot, eventually):
    process("motor_plant", "--ros-args", "-p", "rate:=100.0")
    process("wheel_pid", "--ros-args", "-r", "__ns:=/front_left", "-p", "p:=5.0")
    robot.setpoint = 1.0
    eventually(lambda: robot.velocity("front_left") > 0.3, 30.0, robot.spin)
    excite = process("excite", "--ros-args", "-p", "signal:=square")
    eventually(lambda: excite.returncode is not None, 20.0, robot.spin, excite.output)
    assert excite.returncode == 2 and "/front_left/wheel_pid#" in excite.output
    assert robot.velocity("front_left") > 0.3
    robot.setpoint = None
    excite = process("excite", "--ros-args", "-p", "signal:=square", "-p", "duration:=2.0")
    eventually(lambda: excite.returncode is not None, 20.0, robot.spin, excite.output)
    assert excite.returncode == 0, "a controller at rest does not hold its wheel"


def test_excite_ends_on_overspeed_or_missing_feedback(process, robot, eventually):
    plant = process("motor_plant", "--ros-args", "-p", "rate:=100.0")
    eventually(lambda: robot.states["rear_left"], 20.0, robot.spin)
    square = ("excite", "--ros-args", "-p", "signal:=square")
    excite = process(*square, "-p", "max_speed:=1.0", "-p", "wheels:=[rear_left]")
    eventually(lambda: excite.returncode is not None, 30.0, robot.spin, excite.output)
    assert excite.returncode == 1 and "rear_left: it turns at" in excite.output
    last = robot.commands["rear_left"]
    eventually(lambda: not last or last[-1].voltage == 0.0, 3.0, robot.spin, "no zero command")
    last.clear()
    excite = process(*square, "-p", "wheels:=[rear_left]", "-p", "duration:=60.0")
    # Within these two seconds it has received feedback; the signal itself lasts longer.
    eventually(lambda: len(last) > 200, 20.0, robot.spin, excite.output)
    plant.send_signal(signal.SIGKILL)
    eventually(lambda: excite.returncode is not None, 20.0, robot.spin, excite.output)
    assert excite.returncode == 1 and "rear_left: no motor_state for 1 s" in excite.output


TRUE_GAIN = 25.548
"""DC gain of motor 1, K / (R b + K^2) from Table 1 [rad/s/V]."""


def test_accurate_estimate_is_published_after_sufficient_excitation(process, robot, eventually):
    heard = robot.hear("/front_left/motor_parameters", MotorParameters)
    process("motor_plant")
    settings = ["-p", "period:=1.0", "-p", "window:=12.0", "-p", "wheels:=[front_left]"]
    identifier = process("identifier", "--ros-args", *settings)
    eventually(lambda: heard, 30.0, robot.spin, "nothing heard")
    # At rest: the status lists the missing excitation, and there are no values.
    eventually(lambda: "turned for 0.0" in heard[-1].status, 10.0, robot.spin, "no reason")
    assert all(not m.names and m.status.startswith("collecting") for m in heard)
    assert math.isnan(heard[-1].fit_percent)

    excite = ["-p", "wheels:=[front_left]", "-p", "duration:=15.0", "-p", "amplitude:=9.0"]
    process("excite", "--ros-args", *excite)
    eventually(lambda: heard[-1].names, 60.0, robot.spin, "no estimate")
    found = heard[-1]
    assert found.status.split(":")[0] in ("valid", "unreliable")
    assert found.joint_name == "front_left_wheel_joint"
    k = found.names.index("dc_gain")
    error = abs(found.values[k] - TRUE_GAIN)
    # Five standard deviations, or 0.5 % on a machine that is too busy to keep the plant's time.
    assert error < max(5 * found.std_devs[k], 0.005 * TRUE_GAIN)
    assert found.fit_percent > 80.0

    identifier.send_signal(signal.SIGINT)
    assert identifier.wait(5.0) == 0
