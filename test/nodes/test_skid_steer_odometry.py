# SPDX-License-Identifier: Apache-2.0
"""Odometry of skid_steer as its own process: from feedback, over stalls, in simulated time."""

import math
import signal
import time

import pytest
from body_peer import JOINTS, WHEELS, repeatedly
from rosgraph_msgs.msg import Clock

from smp_interfaces.msg import MotorState


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
