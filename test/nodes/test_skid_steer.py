"""skid_steer as its own process: behaviour cases of diff_drive_controller, and more."""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState

from smp_interfaces.msg import MotorState
from smp_motor_control.nodes.odometry_output import frame_prefix

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
JOINTS = [f"{wheel}_wheel_joint" for wheel in WHEELS]
GEOMETRY = [
    part
    for setting in (
        "wheel_separation:=0.4",
        "wheel_radius:=0.1",
        "max_wheel_velocity:=100.0",
        "publish_rate:=100.0",
    )
    for part in ("-p", setting)
]
BEHAVIOUR = json.loads(
    (Path(__file__).parent.parent / "data" / "conformance" / "diff_drive_cases.json").read_text()
)["behaviour_cases"]


class Peer:
    """The rest of the robot: sends commands and feedback, keeps what skid_steer sends."""

    def __init__(self, domain: int) -> None:
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, domain_id=domain)
        self.node = rclpy.create_node("peer", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.setpoints: list[JointState] = []
        self.odometry: list[Odometry] = []
        self.joints: list[JointState] = []
        self.diagnostics: list = []
        node = self.node
        node.create_subscription(JointState, "wheel_setpoints", self.setpoints.append, 100)
        node.create_subscription(Odometry, "odom", self.odometry.append, 100)
        node.create_subscription(JointState, "joint_states", self.joints.append, 100)
        node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda m: self.diagnostics.extend(m.status), 100
        )
        self.stamped = node.create_publisher(TwistStamped, "cmd_vel", 10)
        self.plain = node.create_publisher(Twist, "cmd_vel_plain", 10)
        self.imu = node.create_publisher(Imu, "imu", 10)
        self.states = {w: node.create_publisher(MotorState, f"{w}/motor_state", 10) for w in WHEELS}
        self.begun: Time | None = None

    def spin(self) -> None:
        self.executor.spin_once(timeout_sec=0.005)

    def spin_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.spin()

    def command(self, v: float, w: float = 0.0, age: float = 0.0, zero_stamp: bool = False) -> None:
        message = TwistStamped()
        if not zero_stamp:
            now = self.node.get_clock().now() - rclpy.duration.Duration(seconds=age)
            message.header.stamp = now.to_msg()
        message.twist.linear.x, message.twist.angular.z = v, w
        self.stamped.publish(message)

    def feed(self, wheel: str, position: float, velocity: float = 0.0) -> None:
        self._feed(wheel, position, velocity, self.node.get_clock().now())

    def feed_all(self, left: float, right: float) -> None:
        for wheel in WHEELS:
            self.feed(wheel, left if wheel.endswith("left") else right)

    def roll(self, speed: float) -> None:
        """Feed where wheels of this speed [rad/s] are at the instant that is stamped."""
        now = self.node.get_clock().now()
        self.begun = self.begun or now
        for wheel in WHEELS:
            self._feed(wheel, speed * (now - self.begun).nanoseconds * 1e-9, speed, now)

    def _feed(self, wheel: str, position: float, velocity: float, stamp: Time) -> None:
        message = MotorState(position=position, velocity=velocity)
        message.header.stamp = stamp.to_msg()
        self.states[wheel].publish(message)

    def speeds(self) -> dict[str, float]:
        """Newest set-points by wheel; empty before the first."""
        if not self.setpoints:
            return {}
        last = self.setpoints[-1]
        return dict(zip(last.name, last.velocity, strict=True))

    def drives(self, left: float, right: float, tolerance: float = 1e-9) -> bool:
        speeds = self.speeds()
        return bool(speeds) and all(
            abs(speeds[joint] - (left if "left" in joint else right)) <= tolerance
            for joint in JOINTS
        )

    def diagnosis(self, text: str) -> bool:
        return any(s.name == "skid_steer" and text in s.message for s in self.diagnostics)

    def set(self, name: str, value: float) -> tuple[bool, str]:
        client = self.node.create_client(SetParameters, "/skid_steer/set_parameters")
        assert client.wait_for_service(5.0)
        parameter = Parameter(
            name=name,
            value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value),
        )
        future = client.call_async(SetParameters.Request(parameters=[parameter]))
        self.executor.spin_until_future_complete(future, 5.0)
        result = future.result().results[0]
        return result.successful, result.reason


@pytest.fixture
def peer(ros_domain: int) -> Iterator[Peer]:
    peer = Peer(ros_domain)
    yield peer
    peer.executor.shutdown()
    peer.node.destroy_node()
    rclpy.shutdown(context=peer.context)


@pytest.fixture
def start(process, peer, eventually):
    def run(*more: str, listens: str = "cmd_vel"):
        started = process("skid_steer", "--ros-args", *GEOMETRY, *more)
        eventually(
            lambda: peer.node.count_subscribers(listens) and peer.setpoints_found(),
            deadline=20.0,
            step=peer.spin,
            message=started.output,
        )
        return started

    peer.setpoints_found = lambda: peer.node.count_publishers("wheel_setpoints")
    return run


def repeatedly(peer: Peer, send, condition, eventually, deadline: float = 5.0) -> None:
    """Send until a condition holds: the first messages may precede the connection."""

    def step() -> None:
        send()
        peer.spin_for(0.03)

    eventually(condition, deadline=deadline, step=step)


def test_only_a_sound_and_fresh_command_starts_the_wheels(start, peer, eventually) -> None:
    started = start()
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


def test_command_turns_all_four_wheels_and_its_timeout_stops_them(start, peer, eventually) -> None:
    start()
    repeatedly(peer, lambda: peer.command(0.0, 1.0), lambda: peer.drives(-2.0, 2.0), eventually)
    assert set(peer.speeds()) == set(JOINTS)
    before = len(peer.setpoints)
    for _ in range(10):
        peer.command(math.nan, math.nan)  # changes nothing, for as long as the last one holds
        peer.spin_for(0.02)
    assert len(peer.setpoints) > before
    seen = {value for message in peer.setpoints[before:] for value in message.velocity}
    assert seen == {-2.0, 2.0}
    # Then cmd_vel_timeout, 0.5 s, from the last sound message on, whatever else comes.
    sent = time.monotonic()
    peer.command(0.0, 1.0)
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


def test_plain_and_stamped_twist_are_understood_one_after_the_other(
    start, peer, eventually
) -> None:
    start("-r", "cmd_vel:=cmd_vel_plain", listens="cmd_vel_plain")
    message = Twist()
    message.linear.x = 1.0
    repeatedly(
        peer, lambda: peer.plain.publish(message), lambda: peer.drives(10.0, 10.0), eventually
    )
    eventually(lambda: peer.drives(0.0, 0.0), deadline=2.0, step=peer.spin)
    # The middleware has one type by topic in a process, so the same peer cannot publish both.
    peer.node.destroy_publisher(peer.plain)
    peer.stamped = peer.node.create_publisher(TwistStamped, "cmd_vel_plain", 10)
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.drives(5.0, 5.0), eventually)


def test_another_type_that_is_published_too_is_named(start, peer, process, eventually) -> None:
    start()
    program = (
        "import rclpy, time\nfrom geometry_msgs.msg import Twist\nrclpy.init()\n"
        "p = rclpy.create_node('nav').create_publisher(Twist, 'cmd_vel', 1)\ntime.sleep(60)\n"
    )
    process(sys.executable, "-c", program)
    said = "also published as Twist, which is not heard"
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.diagnosis(said), eventually, 15.0)
    assert peer.drives(5.0, 5.0)


def test_odometry_follows_simulated_time_at_half_the_pace(start, peer, eventually) -> None:
    """At 1 rad/s of simulated time the body moves at 0.1 m/s of it, whatever passes outside."""
    clock = peer.node.create_publisher(Clock, "/clock", 10)
    start("-p", "use_sim_time:=true")
    eventually(lambda: peer.diagnosis("nothing is heard on /clock"), deadline=5.0, step=peer.spin)
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


def test_odometry_has_no_spikes_after_stalls(start, peer, eventually) -> None:
    """The reference is the speed of the wheels as they are fed: 2 rad/s, 0.2 m/s."""
    started = start()

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
        repeatedly(peer, roll, lambda before=before: len(peer.odometry) > before + 20, eventually)
    speeds = [m.twist.twist.linear.x for m in peer.odometry[30:]]
    assert min(speeds) > 0.8 * 0.2
    assert max(speeds) < 1.2 * 0.2


def test_parameters_change_while_driving_and_nonsense_is_refused_with_its_reason(
    start, peer, eventually
) -> None:
    start("-p", "linear.x.max_acceleration:=0.5")
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
        peer,
        lambda: peer.command(1.0, 2.0),
        lambda: peer.drives(6.0 * 3.0 / 14.0, 3.0),
        eventually,
    )


def test_odometry_follows_the_wheels_from_any_first_position(start, peer, eventually) -> None:
    start("-p", "feedback_timeout:=60.0")  # travel while nothing was heard is left out
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
    # A tick may fall between the four samples of 0.01 rad: 1.25 mrad askew for a way of 1 mm.
    assert last.pose.pose.position.y == pytest.approx(0.0, abs=2e-4)
    # travel_noise of 1e-4 m^2/m on two sides, 0.1 m: (1e-4 * 0.2) / 4.
    assert last.pose.covariance[0] == pytest.approx(5e-6, rel=0.02)
    assert all(math.isfinite(x) for x in (*last.pose.covariance, *last.twist.covariance))
    eventually(lambda: peer.joints[-1].position[0] == 1001.0, deadline=2.0, step=peer.spin)
    assert sorted(peer.joints[-1].name) == sorted(JOINTS)


def test_odometry_is_also_on_tf_where_tf2_msgs_is_installed(start, peer, eventually) -> None:
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not among the wheels")
    seen: list = []
    peer.node.create_subscription(
        tf2_msgs.TFMessage, "/tf", lambda message: seen.extend(message.transforms), 100
    )
    start()
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


def test_lost_or_nan_feedback_is_named_and_never_reaches_the_odometry(
    start, peer, eventually
) -> None:
    start()
    repeatedly(peer, lambda: peer.feed_all(0.0, 0.0), lambda: peer.odometry, eventually)

    def broken() -> None:
        for wheel in WHEELS:
            bad = wheel == "rear_left"
            peer.feed(wheel, math.nan if bad else 0.0, math.inf if bad else 0.0)

    repeatedly(peer, broken, lambda: peer.diagnosis("no feedback from rear_left"), eventually)
    positions = [m.pose.pose.position.x for m in peer.odometry]
    assert all(math.isfinite(x) for x in positions)


def test_heading_is_held_by_the_imu_and_only_while_driving(start, peer, eventually) -> None:
    # A busy machine must not let the imu or the command time out: the hold would begin anew.
    patient = ("-p", "imu_timeout:=60.0", "-p", "cmd_vel_timeout:=60.0")
    start("-p", "heading_hold:=true", "-p", "heading_i:=0.0", *patient)

    def turned(yaw: float, v: float) -> None:
        message = Imu()
        message.orientation.z, message.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        peer.imu.publish(message)
        peer.command(v)

    repeatedly(peer, lambda: turned(0.5, 0.5), lambda: peer.drives(5.0, 5.0), eventually)
    # Turned left by 0.1 rad: 2/s times that, 0.2 rad/s to the right, 0.4 rad/s a side.
    repeatedly(peer, lambda: turned(0.6, 0.5), lambda: peer.drives(5.4, 4.6, 1e-6), eventually)
    repeatedly(peer, lambda: turned(0.6, 0.0), lambda: peer.drives(0.0, 0.0), eventually)


@pytest.mark.parametrize("end", ["interrupt", "terminate"])
def test_wheels_are_left_at_zero_on_exit(start, peer, eventually, end: str) -> None:
    started = start()
    repeatedly(peer, lambda: peer.command(0.5), lambda: peer.drives(5.0, 5.0), eventually)
    if end == "interrupt":
        started.interrupt()
    else:
        started.send_signal(15)
    eventually(lambda: peer.drives(0.0, 0.0), deadline=2.0, step=peer.spin)
    assert started.wait(2.0) == 0
    assert "Traceback" not in started.output


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["-p", "wheel_radius:=-0.1"], "wheel_radius"),
        (["-p", "angular.z.max_velocity:=1.0", "-p", "angular.z.min_velocity:=2.0"], "angular.z"),
        (["-p", "use_stamped_vel:=3"], "use_stamped_vel"),
        (["-p", "left_wheel_names:=[a, front_right]"], "named twice"),
    ],
)
def test_wrong_parameters_end_it_with_one_line(process, arguments: list, named: str) -> None:
    started = process("skid_steer", "--ros-args", *arguments)
    assert started.wait(15.0) == 2
    lines = [line for line in started.output.splitlines() if line.strip()]
    assert len(lines) == 1
    assert named in lines[0]


@pytest.mark.parametrize(
    "row", next(case["table"] for case in BEHAVIOUR if case["id"] == "frame_prefix"), ids=str
)
def test_frames_are_prefixed_as_by_diff_drive_controller(row: dict) -> None:
    prefix = frame_prefix(row["enable"], row["prefix"], row["ns"] or "/")
    assert prefix + "odom" == row["odom"]
