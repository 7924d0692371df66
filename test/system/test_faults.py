# SPDX-License-Identifier: Apache-2.0
"""Fault campaign: plant, wheels and skid_steer as processes, with injected faults.

No node may die, no wheel may turn when it should not, every fault is named on /diagnostics
within its time-out, and driving resumes without a restart.
"""

import itertools
import math
import os
import random
import signal
import struct
import time
from collections.abc import Callable

import pytest
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import JointState
from wheel_robot import Relay, WheelRobot

from smp_interfaces.msg import MotorCommand, MotorState
from smp_motor_control import WHEELS

WHEEL = "front_left"
NODE = f"{WHEEL}/wheel_pid"
SPEED = 1.5
GAINS = (
    "p:=1.5", "i:=20.0", "u_clamp_min:=-12.0", "u_clamp_max:=12.0",
    "antiwindup_strategy:=back_calculation", "max_acceleration:=15.0",
    # A machine that runs tests is busy; these would be a tenth on a robot.
    "feedback_timeout:=0.4", "setpoint_timeout:=0.5", "stall_time:=0.4", "fault_retry:=1.0",
)  # fmt: skip
SAMPLE = 0.01
"""Sample interval of the plant [s]."""
TIMEOUT = 2.0
"""Longest time-out of all [s], with a second for /diagnostics and a busy machine."""


def stamp(message: MotorState | MotorCommand) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def true_speed(robot: WheelRobot) -> float:
    """Return the speed of the plant, upstream of the relay."""
    last = robot.states["raw"][-10:]
    if len(last) < 10:
        return math.nan
    return (last[-1].position - last[0].position) / (stamp(last[-1]) - stamp(last[0]))


class Campaign:
    """One wheel behind a relay, driving."""

    def __init__(self, process, robot: WheelRobot, eventually) -> None:
        self.robot, self.eventually = robot, eventually
        self.relay = Relay(robot, WHEEL)
        self.plant = process(
            "motor_plant", "--ros-args", "-p", "rate:=100.0",
            "-r", f"{WHEEL}/motor_state:={WHEEL}/raw_state",
        )  # fmt: skip
        given = [part for one in GAINS for part in ("-p", one)]
        self.wheel = process("wheel_pid", "--ros-args", "-r", f"__ns:=/{WHEEL}", *given)
        eventually(lambda: robot.commands[WHEEL], 30.0, robot.spin, "no command")
        robot.setpoint = SPEED
        self.drives()

    def drives(self) -> None:
        """Wait until the wheel follows its set-point."""
        self.eventually(
            lambda: abs(true_speed(self.robot) - SPEED) < 0.1 * SPEED,
            12.0,
            self.robot.spin,
            f"does not drive: {self.robot.last_diagnosis(NODE)}; {self.wheel.output}",
        )

    def is_sound(self) -> None:
        """Wait until the wheel drives by itself again, then reset the retries of the fault."""
        self.drives()
        self.robot.trigger(NODE, "reset")
        self.drives()

    def stops(self, within: float = TIMEOUT) -> None:
        """Wait until the wheel has stopped."""
        self.eventually(
            lambda: abs(true_speed(self.robot)) < 0.03,
            within + 1.0,
            self.robot.spin,
            f"turns on: {true_speed(self.robot)}",
        )

    def names(self, text: str, since: float, within: float = TIMEOUT) -> None:
        """Wait until the node names a fault."""
        self.eventually(
            lambda: self.robot.named(NODE, text, since),
            within,
            self.robot.spin,
            f"does not name {text!r}: {self.robot.last_diagnosis(NODE)}",
        )


@pytest.mark.slow
def test_feedback_faults_are_reported_stop_the_wheel_and_driving_resumes(
    process, robot, eventually
):
    campaign = Campaign(process, robot, eventually)
    relay = campaign.relay
    stopping: list[tuple[str, Callable[[], None], str]] = [
        ("lost", lambda: setattr(relay, "fault", lambda m: []), "no feedback"),
        ("frozen", relay.freezes, "no counts under voltage"),
        ("delayed 500 ms", lambda: relay.delays(0.5), "late"),
        ("not a number", lambda: relay.changes(velocity=math.nan), "not a number"),
        ("infinite", lambda: relay.changes(velocity=math.inf), "not a number"),
    ]
    for _, begin, words in stopping:
        since = time.monotonic()
        begin()
        campaign.names(words, since)
        campaign.stops()
        relay.passes()
        campaign.is_sound()

    since, n = time.monotonic(), len(robot.states["raw"])
    relay.changes(velocity=lambda v: -v, encoder_count=lambda n: -n, position=lambda p: -p)
    campaign.names("runaway", since)
    # Commands carry the stamp of their sample; samples lost on a busy machine are subtracted.
    begin = stamp(robot.states["raw"][n])
    answers = [(stamp(c), c.voltage) for c in robot.commands[WHEEL] if stamp(c) >= begin]
    end = next(at for at, voltage in answers if voltage == 0.0)
    stamps = [begin, *(at for at, _ in answers if at <= end)]
    lost = sum(max(b - a - 2 * SAMPLE, 0.0) for a, b in itertools.pairwise(stamps))
    assert end - begin <= 0.5 + SAMPLE + lost
    campaign.eventually(lambda: abs(true_speed(robot)) < 0.5, 3.0, robot.spin, "runs away")
    relay.passes()
    campaign.drives()

    for _, begin, words in (
        ("duplicated", lambda: setattr(relay, "fault", lambda m: [m, m]), "duplicate"),
        ("clock back by 10 s", lambda: relay.shifts_stamps(-10.0), "clock jumps"),
        ("and forward again", relay.passes, "clock jumps"),
        ("voltage nan", lambda: relay.changes(voltage=math.nan), "driving"),
        ("current inf", lambda: relay.changes(current=math.inf), "driving"),
        ("position nan", lambda: relay.changes(position=math.nan), "driving"),
    ):
        since = time.monotonic()
        begin()
        campaign.names(words, since, within=5.0)  # faults that stop no wheel have no time-out
        campaign.drives()
        relay.passes()
        campaign.drives()
    assert campaign.wheel.returncode is None and campaign.plant.returncode is None


def extreme(draw: random.Random) -> float:
    """Return an extreme or an ordinary random number."""
    return draw.choice(
        [math.nan, math.inf, -math.inf, 1.7e308, -1.7e308, 5e-324, -0.0, draw.gauss(0.0, 1e3)]
    )


@pytest.mark.slow
def test_nodes_survive_ten_thousand_malformed_and_extreme_messages(process, robot, eventually):
    campaign = Campaign(process, robot, eventually)
    draw = random.Random(5)
    stamps = [0, 1, 2**31 - 1, -1, -(2**31)]
    command = robot.node.create_publisher(MotorCommand, f"/{WHEEL}/motor_command", 10)
    raw = campaign.relay.publisher
    for k in range(10_000):
        kind = k % 4
        if kind == 0:
            message = MotorState(
                voltage=extreme(draw), current=extreme(draw), velocity=extreme(draw),
                position=extreme(draw), duty_cycle=extreme(draw),
                encoder_count=draw.choice([0, 2**63 - 1, -(2**63), draw.getrandbits(40)]),
            )  # fmt: skip
            message.header.stamp.sec = draw.choice([*stamps, int(time.time())])
            message.header.stamp.nanosec = draw.choice([0, 2**32 - 1, 999_999_999])
            raw.publish(message)
        elif kind == 1:
            message = JointState(
                name=[draw.choice(["", "x" * 300, f"{WHEEL}_wheel_joint"])] * draw.randrange(4),
                velocity=[extreme(draw)] * draw.randrange(4),
            )
            message.header.stamp.sec = draw.choice(stamps)
            robot.setpoints.publish(message)
        elif kind == 2:
            command.publish(MotorCommand(voltage=draw.choice([math.nan, math.inf, -math.inf])))
        else:
            # A well-formed header followed by random bytes
            size = draw.randrange(0, 60)
            raw.publish(struct.pack("<I", 256) + draw.randbytes(size))
        if k % 50 == 0:
            robot.spin()
    assert campaign.wheel.returncode is None, campaign.wheel.output
    assert campaign.plant.returncode is None, campaign.plant.output
    campaign.drives()
    robot.setpoint = None
    campaign.stops()


@pytest.mark.slow
def test_every_node_may_be_killed_and_restarted_while_driving(process, robot, eventually):
    given = [part for one in GAINS for part in ("-p", one)]
    starts = {
        "motor_plant": ("motor_plant", "--ros-args", "-p", "rate:=100.0"),
        "skid_steer": ("skid_steer", "--ros-args", "-p", "wheel_separation:=0.4",
                       "-p", "wheel_radius:=0.1"),
        **{w: ("wheel_pid", "--ros-args", "-r", f"__ns:=/{w}", *given) for w in WHEELS},
    }  # fmt: skip
    nodes = {name: process(*command) for name, command in starts.items()}
    drive = robot.node.create_publisher(TwistStamped, "/cmd_vel", 10)

    def step() -> None:
        message = TwistStamped()
        message.header.stamp = robot.node.get_clock().now().to_msg()
        message.twist.linear.x = 0.1 * SPEED
        drive.publish(message)
        robot.spin_for(0.02)

    def all_drive() -> bool:
        return all(abs(robot.velocity(w) - SPEED) < 0.15 * SPEED for w in WHEELS)

    def still(wheels: tuple[str, ...]) -> bool:
        return all(abs(robot.velocity(w, 5)) < 0.05 for w in wheels)

    eventually(all_drive, 40.0, step, "does not drive at first")
    for name in starts:
        os.kill(nodes[name].pid, signal.SIGKILL)
        nodes[name].wait(5.0)
        since = time.monotonic()
        if name == "motor_plant":
            expected, words = f"{WHEELS[0]}/wheel_pid", "no feedback"
        elif name == "skid_steer":
            expected, words = f"{WHEELS[0]}/wheel_pid", "set-point timed out"
        else:
            expected, words = "", ""
        if words:
            eventually(lambda e=expected, w=words, s=since: robot.named(e, w, s), 8.0, step, words)
        if name != "motor_plant":
            stopped = WHEELS if name == "skid_steer" else (name,)
            eventually(lambda s=stopped: still(s), 5.0, step, f"turns on without {name}")
        nodes[name] = process(*starts[name])
        eventually(all_drive, 30.0, step, f"does not drive again after {name}")
    assert all(node.returncode is None for node in nodes.values())
