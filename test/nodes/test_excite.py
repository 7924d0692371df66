# SPDX-License-Identifier: Apache-2.0
"""excite as its own process, on a simulated motor."""

import signal


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
