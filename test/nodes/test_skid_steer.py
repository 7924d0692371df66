# SPDX-License-Identifier: Apache-2.0
"""skid_steer as its own process: commands, limits, parameters, exit, and odometry."""

import json
import math
import signal
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from body_peer import JOINTS, WHEELS, repeatedly
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState

from smp_interfaces.msg import MotorState
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
    assert peer.set("skid_steer", **{name: float(value)}) == (True, "")
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
        successful, said = peer.set("skid_steer", **{name: value})
        assert not successful
        assert name.removesuffix(".max_acceleration").removeprefix("heading_") in said
    peer.setpoints.clear()
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.drives(5.0, 5.0), eventually)
    assert peer.set("skid_steer", linear__x__max_velocity=0.4)[0]
    repeatedly(peer, lambda: peer.command(1.0), lambda: peer.drives(4.0, 4.0), eventually)
    assert peer.set("skid_steer", linear__x__max_velocity=math.nan)[0]
    assert peer.set("skid_steer", linear__x__max_acceleration=math.nan)[0]
    # 1 m/s and 2 rad/s ask for 6 and 14 rad/s: both shrink by 3/14 and the path keeps its shape.
    assert peer.set("skid_steer", max_wheel_velocity=3.0)[0]
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


def test_odometry_follows_simulated_time_at_half_speed(skid_steer, peer, eventually):
    """At 1 rad/s of simulated time the body moves at 0.1 m/s of simulated time."""
    clock = peer.node.create_publisher(Clock, "/clock", 10)
    skid_steer("-p", "use_sim_time:=true")
    eventually(lambda: peer.diagnosis("/clock is not published"), deadline=5.0, step=peer.spin)
    begun = time.monotonic()

    def simulate() -> None:
        now = 100.0 + 0.5 * (time.monotonic() - begun)
        message = Clock()
        message.clock.sec, message.clock.nanosec = int(now), int(now % 1 * 1e9)
        clock.publish(message)
        for wheel in WHEELS:
            state = MotorState(position=now)
            state.header.stamp = message.clock
            peer.states[wheel].publish(state)

    repeatedly(
        peer,
        simulate,
        lambda: (
            peer.odometry
            and peer.odometry[-1].header.stamp.sec >= 101
            and abs(peer.odometry[-1].twist.twist.linear.x - 0.1) < 1e-3
        ),
        eventually,
        20.0,
    )
    assert peer.odometry[-1].pose.pose.position.x < 0.1 * 0.5 * (time.monotonic() - begun) + 0.01


def test_odometry_continues_after_clock_jumps(skid_steer, peer, eventually):
    """ros-controls/ros_controllers issue 101: silence until the clock has caught up."""
    clock = peer.node.create_publisher(Clock, "/clock", 10)
    skid_steer("-p", "use_sim_time:=true")
    now = 1000.0

    def simulate() -> None:
        nonlocal now
        now += 0.01
        message = Clock()
        message.clock.sec, message.clock.nanosec = int(now), int(now % 1 * 1e9)
        clock.publish(message)
        for wheel in WHEELS:
            state = MotorState(position=now % 1000.0)
            state.header.stamp = message.clock
            peer.states[wheel].publish(state)

    repeatedly(peer, simulate, lambda: len(peer.odometry) > 20, eventually, 20.0)
    for jump in (-500.0, 300.0):
        now += jump
        before = len(peer.odometry)
        ends = lambda before=before: len(peer.odometry) > before + 10  # noqa: E731
        repeatedly(peer, simulate, ends, eventually, 20.0)
        assert abs(peer.odometry[-1].header.stamp.sec - now) < 5.0
        assert abs(peer.odometry[-1].twist.twist.linear.x) < 0.2


def test_speed_is_exactly_zero_at_standstill(skid_steer, peer, eventually):
    """ros-controls/ros2_controllers issue 1972: 5e-14 m/s for ever."""
    skid_steer()
    repeatedly(peer, lambda: peer.roll(2.0), lambda: len(peer.odometry) > 30, eventually)
    peer.odometry.clear()
    stand = lambda: peer.feed_all(3.1, 2.7)  # noqa: E731
    repeatedly(peer, stand, lambda: len(peer.odometry) > 60, eventually)
    last = peer.odometry[-1].twist.twist
    assert (last.linear.x, last.angular.z) == (0.0, 0.0)


def test_odometry_has_no_spikes_after_stalls(skid_steer, peer, eventually):
    """The true speed is that of the feedback: 2 rad/s, 0.2 m/s."""
    started = skid_steer()

    def roll() -> None:
        peer.roll(2.0)

    repeatedly(peer, roll, lambda: len(peer.odometry) > 30, eventually)
    for pause in [0.12] * 8 + [1.0]:
        started.send_signal(signal.SIGSTOP)
        end = time.monotonic() + pause
        while time.monotonic() < end:
            roll()
            peer.spin_for(0.01)
        started.send_signal(signal.SIGCONT)
        before = len(peer.odometry)
        repeatedly(peer, roll, lambda before=before: len(peer.odometry) > before + 10, eventually)
    speeds = [m.twist.twist.linear.x for m in peer.odometry[30:]]
    assert min(speeds) > 0.8 * 0.2
    assert max(speeds) < 1.2 * 0.2


def test_odometry_starts_at_zero_for_any_initial_wheel_position(skid_steer, peer, eventually):
    skid_steer("-p", "feedback_timeout:=60.0")
    # Wheels that start at 1000 and 2000 rad, and then roll 1 rad: 0.1 m.
    repeatedly(
        peer,
        lambda: peer.feed_all(1000.0, 2000.0),
        lambda: peer.joints and len(peer.joints[-1].name) == 4,
        eventually,
    )
    for k in range(1, 101):
        peer.feed_all(1000.0 + 0.01 * k, 2000.0 + 0.01 * k)
        peer.spin_for(0.005)
    eventually(
        lambda: peer.odometry and abs(peer.odometry[-1].pose.pose.position.x - 0.1) < 1e-6,
        deadline=3.0,
        step=lambda: (peer.feed_all(1001.0, 2001.0), peer.spin_for(0.03)),
    )
    last = peer.odometry[-1]
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "base_link")
    # An update may fall between the four samples of 0.01 rad: 1.25 mrad of heading over 1 mm.
    assert last.pose.pose.position.y == pytest.approx(0.0, abs=2e-4)
    # travel_noise of 1e-4 m^2/m on two sides, 0.1 m: (1e-4 * 0.2) / 4.
    assert last.pose.covariance[0] == pytest.approx(5e-6, rel=0.02)
    assert all(math.isfinite(x) for x in (*last.pose.covariance, *last.twist.covariance))
    eventually(lambda: peer.joints[-1].position[0] == 1001.0, deadline=2.0, step=peer.spin)
    assert sorted(peer.joints[-1].name) == sorted(JOINTS)


def test_odometry_is_also_published_on_tf_if_tf2_msgs_is_installed(skid_steer, peer, eventually):
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not among the wheels")
    seen: list = []
    peer.node.create_subscription(
        tf2_msgs.TFMessage, "/tf", lambda message: seen.extend(message.transforms), 100
    )
    skid_steer()
    travel = iter(0.01 * k for k in range(100_000))
    repeatedly(
        peer,
        lambda: peer.feed_all(*(2 * [next(travel)])),
        lambda: seen and seen[-1].transform.translation.x > 0.01,
        eventually,
    )
    assert (seen[-1].header.frame_id, seen[-1].child_frame_id) == ("odom", "base_link")
    last = seen[-1].header.stamp
    same = [o for o in peer.odometry if o.header.stamp == last]
    assert same, "each transform has an odometry of the same stamp"
    assert same[0].pose.pose.position.x == seen[-1].transform.translation.x
    assert same[0].pose.pose.orientation == seen[-1].transform.rotation


def test_invalid_feedback_is_reported_and_never_reaches_odometry(skid_steer, peer, eventually):
    skid_steer()
    repeatedly(peer, lambda: peer.feed_all(0.0, 0.0), lambda: peer.odometry, eventually)

    def broken() -> None:
        for wheel in WHEELS:
            bad = wheel == "rear_left"
            peer.feed(wheel, math.nan if bad else 0.0, math.inf if bad else 0.0)

    repeatedly(peer, broken, lambda: peer.diagnosis("no feedback from rear_left"), eventually)
    positions = [m.pose.pose.position.x for m in peer.odometry]
    assert all(math.isfinite(x) for x in positions)
