# SPDX-License-Identifier: Apache-2.0
"""skid_steer as its own process: commands, limits, parameters, exit."""

import json
import math
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from body_peer import JOINTS, repeatedly
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from sensor_msgs.msg import Imu, JointState

from smp_motor_control.nodes.skid_steer import frame_prefix

BEHAVIOUR = json.loads(
    (Path(__file__).parent.parent / "data" / "conformance" / "diff_drive_cases.json").read_text()
)["behaviour_cases"]


def test_only_finite_and_fresh_commands_start_the_wheels(skid_steer, peer, eventually):
    started = skid_steer()
    eventually(lambda: peer.diagnosis(""), deadline=5.0, step=peer.spin)
    for _ in range(8):
        peer.command(math.nan, 0.0)
        peer.command(0.0, math.inf)
        peer.spin_for(0.02)
    eventually(lambda: peer.diagnosis("not finite"), deadline=3.0, step=peer.spin)
    for _ in range(8):
        peer.command(1.0, age=0.6)
        peer.spin_for(0.02)
    eventually(lambda: peer.diagnosis("older than the time-out"), deadline=3.0, step=peer.spin)
    assert peer.setpoints == []
    # A zero stamp is taken as now, with one warning.
    for _ in range(8):
        peer.command(0.5, zero_stamp=True)
        peer.spin_for(0.02)
    eventually(lambda: peer.drives(5.0, 5.0), deadline=2.0, step=peer.spin)
    eventually(lambda: "stamp is zero" in started.output)
    assert started.output.count("stamp is zero") == 1


def test_command_turns_all_four_wheels_and_its_timeout_stops_them(skid_steer, peer, eventually):
    skid_steer()
    repeatedly(peer, lambda: peer.command(0.0, 1.0), lambda: peer.drives(-2.0, 2.0), eventually)
    assert set(peer.speeds()) == set(JOINTS)
    before = len(peer.setpoints)
    for _ in range(10):
        peer.command(math.nan, math.nan)  # changes nothing while the last command is valid
        peer.spin_for(0.02)
    assert len(peer.setpoints) > before
    seen = {value for message in peer.setpoints[before:] for value in message.velocity}
    assert seen == {-2.0, 2.0}
    # The time-out of 0.5 s counts from the last valid message.
    peer.setpoints.clear()
    sent = time.monotonic()
    peer.command(0.0, 1.0)
    eventually(lambda: peer.drives(-2.0, 2.0), deadline=2.0, step=peer.spin)
    repeatedly(
        peer,
        lambda: peer.command(math.nan, math.inf),
        lambda: peer.drives(0.0, 0.0),
        eventually,
        2.0,
    )
    assert time.monotonic() - sent >= 0.45
    repeatedly(peer, lambda: peer.feed_all(0.0, 0.0), lambda: peer.diagnosis("idle"), eventually)
    assert peer.diagnostics[-1].level == DiagnosticStatus.OK
    repeatedly(peer, lambda: peer.command(1.0), lambda: peer.drives(10.0, 10.0), eventually, 1.0)


def test_idle_body_yields_wheels_to_another_node(skid_steer, peer, eventually):
    skid_steer()
    repeatedly(peer, lambda: peer.command(1.0), lambda: peer.drives(10.0, 10.0), eventually)
    eventually(lambda: peer.drives(0.0, 0.0), deadline=3.0, step=peer.spin)
    own = peer.node.create_publisher(JointState, "/wheel_setpoints", 10)
    message = JointState(name=list(JOINTS), velocity=[1.5] * len(JOINTS))

    def send() -> None:
        message.header.stamp = peer.node.get_clock().now().to_msg()
        own.publish(message)

    def is_alone() -> bool:
        peer.setpoints.clear()
        for _ in range(10):
            send()
            peer.spin_for(0.02)
        return {v for one in peer.setpoints for v in one.velocity} == {1.5}

    eventually(is_alone, deadline=5.0)
    # A body that is commanded does not yield, and one without rivals holds the wheels again.
    repeatedly(
        peer, lambda: (send(), peer.command(1.0)), lambda: peer.drives(10.0, 10.0), eventually
    )
    eventually(lambda: peer.drives(0.0, 0.0), deadline=3.0, step=peer.spin)


def test_plain_and_stamped_twist_are_accepted_in_turn(skid_steer, peer, eventually):
    skid_steer("-r", "cmd_vel:=cmd_vel_plain", listens="cmd_vel_plain")
    message = Twist()
    message.linear.x = 1.0
    repeatedly(
        peer, lambda: peer.plain.publish(message), lambda: peer.drives(10.0, 10.0), eventually
    )
    eventually(lambda: peer.drives(0.0, 0.0), deadline=2.0, step=peer.spin)
    # A process has one type per topic in the middleware, so one peer cannot publish both.
    peer.node.destroy_publisher(peer.plain)
    peer.stamped = peer.node.create_publisher(TwistStamped, "cmd_vel_plain", 10)
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.drives(5.0, 5.0), eventually)


def test_second_command_type_on_the_topic_is_reported(skid_steer, peer, process, eventually):
    skid_steer()
    program = (
        "import rclpy, time\nfrom geometry_msgs.msg import Twist\nrclpy.init()\n"
        "p = rclpy.create_node('nav').create_publisher(Twist, 'cmd_vel', 1)\ntime.sleep(60)\n"
    )
    process(sys.executable, "-c", program)
    said = "also published as Twist, which is ignored"
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.diagnosis(said), eventually, 15.0)
    assert peer.drives(5.0, 5.0)


def test_command_time_out_brakes_within_acceleration_limit(skid_steer, peer, eventually):
    """ros-navigation/navigation2 issue 3481: a time-out that stops at once."""
    skid_steer("-p", "linear.x.max_acceleration:=1.0")
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.drives(5.0, 5.0), eventually)
    peer.setpoints.clear()
    eventually(lambda: peer.drives(0.0, 0.0), 5.0, peer.spin)
    braking = [m.velocity[0] for m in peer.setpoints if 0.0 < m.velocity[0] < 5.0]
    # 0.5 m/s at 1 m/s^2 in steps of 10 ms; a busy machine's are longer, up to 50 ms.
    assert len(braking) >= 9
    assert max(a - b for a, b in pairwise([5.0, *braking, 0.0])) < 0.51


@pytest.mark.parametrize(
    "limit", ["linear.x.max_acceleration:=0.01", "linear.x.max_jerk:=0.01", "stop_time:=0.3"]
)
def test_body_stops_within_stop_time_for_any_limits(skid_steer, peer, eventually, limit):
    """A command of 0.5 m/s that it reached without limits, then zero under the limit."""
    skid_steer()
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.drives(5.0, 5.0), eventually)
    name, value = limit.split(":=")
    peer.command(0.5)
    assert peer.set(name, float(value)) == (True, "")
    peer.setpoints.clear()
    asked = peer.node.get_clock().now().nanoseconds * 1e-9
    repeatedly(peer, lambda: peer.command(0.0), lambda: peer.drives(0.0, 0.0), eventually)
    first = next(m for m in peer.setpoints if not any(m.velocity))
    taken = first.header.stamp.sec + 1e-9 * first.header.stamp.nanosec - asked
    assert taken < 1.2
    peer.setpoints.clear()
    repeatedly(peer, lambda: peer.command(1e-4), lambda: len(peer.setpoints) > 20, eventually)
    assert peer.drives(0.0, 0.0) or name == "stop_time"


def test_parameters_change_while_driving_and_invalid_ones_are_refused(skid_steer, peer, eventually):
    skid_steer("-p", "linear.x.max_acceleration:=0.5")
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.drives(5.0, 5.0), eventually)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in peer.setpoints]
    # 0.5 m/s at 0.5 m/s^2 takes 1 s; the timer's own jitter is a few periods of 10 ms.
    moving = sum(m.velocity[0] < 5.0 - 1e-9 for m in peer.setpoints)
    assert stamps[moving] - stamps[0] >= 0.9
    nonsense = {
        "wheel_radius": 0.0,
        "wheel_separation": math.nan,
        "cmd_vel_timeout": -1.0,
        "heading_max_error": -1.0,
        "linear.x.max_acceleration": -1.0,
    }
    for name, value in nonsense.items():
        successful, said = peer.set(name, value)
        assert not successful
        assert name.removesuffix(".max_acceleration").removeprefix("heading_") in said
    peer.setpoints.clear()
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.drives(5.0, 5.0), eventually)
    assert peer.set("linear.x.max_velocity", 0.4)[0]
    repeatedly(peer, lambda: peer.command(1.0), lambda: peer.drives(4.0, 4.0), eventually)
    assert peer.set("linear.x.max_velocity", math.nan)[0]
    assert peer.set("linear.x.max_acceleration", math.nan)[0]
    # 1 m/s and 2 rad/s ask for 6 and 14 rad/s: both shrink by 3/14 and the path keeps its shape.
    assert peer.set("max_wheel_velocity", 3.0)[0]
    repeatedly(
        peer, lambda: peer.command(1.0, 2.0), lambda: peer.drives(6.0 * 3.0 / 14.0, 3.0), eventually
    )


def test_heading_is_held_from_imu_only_while_driving(skid_steer, peer, eventually):
    # Neither imu nor command may time out on a busy machine: the hold would restart.
    patient = ("-p", "imu_timeout:=60.0", "-p", "cmd_vel_timeout:=60.0")
    skid_steer("-p", "heading_hold:=true", "-p", "heading_i:=0.0", *patient)

    def turned(yaw: float, v: float) -> None:
        message = Imu()
        message.orientation.z, message.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        peer.imu.publish(message)
        peer.command(v)

    # Turning wheels show that cmd_vel is received, not that the imu is.
    missing = "heading is not held: no imu"
    repeatedly(peer, lambda: peer.command(0.0), lambda: peer.diagnosis(missing), eventually)
    repeatedly(
        peer,
        lambda: turned(0.5, 0.0),
        lambda: missing not in peer.diagnostics[-1].message,
        eventually,
    )
    repeatedly(peer, lambda: turned(0.5, 0.5), lambda: peer.drives(5.0, 5.0), eventually)
    # Turned left by 0.1 rad: 2/s times that, 0.2 rad/s to the right, 0.4 rad/s a side.
    repeatedly(peer, lambda: turned(0.6, 0.5), lambda: peer.drives(5.4, 4.6, 1e-6), eventually)
    repeatedly(peer, lambda: turned(0.6, 0.0), lambda: peer.drives(0.0, 0.0), eventually)


@pytest.mark.parametrize("end", ["interrupt", "terminate"])
def test_wheels_are_commanded_to_zero_on_exit(skid_steer, peer, eventually, end):
    started = skid_steer()
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.drives(5.0, 5.0), eventually)
    if end == "interrupt":
        started.interrupt()
    else:
        started.send_signal(15)
    eventually(lambda: peer.drives(0.0, 0.0), deadline=2.0, step=peer.spin)
    assert started.wait(2.0) == 0
    assert "Traceback" not in started.output


@pytest.mark.parametrize(
    "row", next(case["table"] for case in BEHAVIOUR if case["id"] == "frame_prefix"), ids=str
)
def test_frame_prefix_matches_diff_drive_controller(row):
    prefix = frame_prefix(row["enable"], row["prefix"], row["ns"] or "/")
    assert prefix + "odom" == row["odom"]
