# SPDX-License-Identifier: Apache-2.0
"""wheel_pid as its own process, fed by the test sample by sample."""

import math
import os
import signal
import subprocess
import sys
import time

import pytest
from sensor_msgs.msg import JointState
from wheel_robot import WheelRobot

WHEEL = "front_left"
NODE = "front_left/wheel_pid"
MS = 1_000_000


class Feed:
    """Feeds one sample after the other and waits for the command that answers each."""

    def __init__(self, robot: WheelRobot, eventually) -> None:
        self.robot, self.eventually = robot, eventually
        self.stamp = 0
        self.commands = robot.commands[WHEEL]

    def sample(self, velocity: float, dt: float = 0.0, **fields) -> float:
        """Return the voltage that answers a sample stamped now, or ``dt`` after the last."""
        self.stamp = self.stamp + round(dt * 1e9) if dt else max(time.time_ns(), self.stamp + MS)
        stamp = self.stamp
        self.robot.feed(WHEEL, stamp, velocity=velocity, **fields)
        self.eventually(lambda: self._answered(stamp), 3.0, self.robot.spin, "no answer")
        return self.commands[-1].voltage

    def _answered(self, stamp: int) -> bool:
        """Tell whether the last command is the sample's, or a zero sent after it."""
        if not self.commands:
            return False
        last = self.commands[-1].header.stamp
        answered = last.sec * 10**9 + last.nanosec
        return answered == stamp or (answered > stamp and self.commands[-1].voltage == 0.0)


@pytest.fixture
def start(process, robot, eventually):
    def begin(*given: str):
        parameters = [part for one in given for part in ("-p", one)]
        node = process(
            "wheel_pid", "--ros-args", "-r", f"__ns:=/{WHEEL}", "-p", "feedback_timeout:=1.0",
            "-p", "stall_time:=0.0", *parameters,
        )  # fmt: skip
        eventually(
            lambda: robot.named(NODE, ""), 20.0, robot.spin, f"no diagnostics: {node.output}"
        )
        # Discovery of set-points and feedback is done when a sample is answered.
        return node

    return begin


def settle(robot: WheelRobot, feed: Feed) -> None:
    """Wait until the node hears feedback and the test hears its commands."""
    end = time.monotonic() + 20.0
    while not robot.commands[WHEEL]:
        assert time.monotonic() < end, "no command"
        robot.feed(WHEEL, time.time_ns())
        robot.spin_for(0.02)
    robot.spin_for(0.1)


def test_one_pid_step_per_sample_with_dt_from_the_stamps(start, robot, eventually):
    start("p:=2.0", "i:=10.0", "setpoint_timeout:=30.0")
    feed = Feed(robot, eventually)
    settle(robot, feed)
    assert feed.sample(0.0) == 0.0, "moved before the first set-point"

    for nonsense in (math.nan, math.inf, -math.inf, 1e300):
        robot.send_setpoint(nonsense)
        robot.spin_for(0.05)
        assert feed.sample(0.0) == 0.0, f"moved on a set-point of {nonsense}"
    stale = JointState(name=[f"{WHEEL}_wheel_joint"], velocity=[1.0])
    stale.header.stamp.sec = int(time.time()) - 60
    robot.setpoints.publish(stale)
    robot.spin_for(0.05)
    assert feed.sample(0.0) == 0.0, "moved on a set-point older than its time-out"
    robot.send_setpoint(1.0, wheels=("rear_left",))
    robot.spin_for(0.05)
    assert feed.sample(0.0) == 0.0, "moved on another wheel's set-point"
    for words in ("set-point that is not a number", "set-point older than its time-out"):
        eventually(lambda words=words: robot.named(NODE, words), 3.0, robot.spin, words)

    robot.send_setpoint(1.0)
    eventually(lambda: feed.sample(0.0) != 0.0, 3.0)
    feed.sample(0.5)
    before, last = feed.sample(0.5, 0.01), 0.01
    for dt in (0.02, 0.005, 0.011):
        after = feed.sample(0.5, dt)
        # Forward Euler, as control_toolbox: a step shows the integral of the step before.
        assert after - before == pytest.approx(10.0 * 0.5 * last, abs=1e-6)
        before, last = after, dt


def test_duplicate_old_or_invalid_feedback_is_ignored(start, robot, eventually):
    start("p:=2.0", "setpoint_timeout:=30.0")
    feed = Feed(robot, eventually)
    settle(robot, feed)
    eventually(lambda: robot.setpoints.get_subscription_count(), 5.0, robot.spin)
    robot.send_setpoint(1.0)
    robot.spin_for(0.05)
    eventually(lambda: feed.sample(0.5) == pytest.approx(1.0), 3.0)
    answers = len(feed.commands)
    for stamp, velocity in (
        (feed.stamp, 0.7),
        (feed.stamp - 5 * MS, 0.7),
        (feed.stamp + 10 * MS, math.nan),
        (feed.stamp + 11 * MS, math.inf),
        (feed.stamp + 12 * MS, -1e300),
    ):
        robot.feed(WHEEL, stamp, velocity=velocity)
    robot.spin_for(0.2)
    assert len(feed.commands) == answers
    assert feed.sample(0.5) == pytest.approx(1.0)
    for words in ("duplicate", "out of order", "feedback velocity"):
        eventually(lambda words=words: robot.named(NODE, words), 3.0, robot.spin, words)
    extreme = dict(voltage=math.nan, current=math.inf, position=-math.inf, duty_cycle=math.nan)
    assert feed.sample(0.5, encoder_count=-(2**63), **extreme) == pytest.approx(1.0)


def test_watchdogs_and_deactivation_command_zero_volts(start, robot, eventually):
    node = start("p:=2.0", "setpoint_timeout:=0.3", "feedback_timeout:=0.3")
    feed = Feed(robot, eventually)
    settle(robot, feed)
    drives = lambda: feed.sample(0.0) == pytest.approx(2.0)  # noqa: E731
    eventually(drives, 5.0, lambda: robot.send_setpoint(1.0))
    begin = time.monotonic()
    eventually(lambda: feed.sample(0.0) == 0.0, 2.0)
    assert time.monotonic() - begin > 0.1  # test_wheel_controller checks the exact time
    # Feedback continues meanwhile; on a busy machine it may have timed out first.
    timed_out = "set-point timed out"
    eventually(lambda: feed.sample(0.0) == 0.0 and robot.named(NODE, timed_out, begin), 2.0)

    robot.setpoint = 1.0
    eventually(lambda: feed.sample(0.0) == pytest.approx(2.0), 3.0)
    begin = time.monotonic()
    eventually(lambda: robot.commands[WHEEL][-1].voltage == 0.0, 2.0, robot.spin)
    eventually(lambda: robot.named(NODE, "no feedback", begin), 1.0, robot.spin)

    eventually(lambda: feed.sample(0.0) == pytest.approx(2.0), 3.0)
    assert robot.transition(NODE, "deactivate")

    def silent() -> bool:
        before = len(feed.commands)
        robot.spin_for(0.3)
        return len(feed.commands) == before

    eventually(silent, 5.0)  # the last zeros have come
    assert feed.commands[-1].voltage == 0.0
    answers = len(feed.commands)
    for _ in range(5):
        robot.feed(WHEEL, time.time_ns(), velocity=0.0)
        robot.spin_for(0.02)
    assert len(feed.commands) == answers, "answered while inactive"
    assert robot.transition(NODE, "cleanup") and robot.transition(NODE, "configure")
    assert robot.transition(NODE, "activate")
    eventually(lambda: feed.sample(0.0) == pytest.approx(2.0), 3.0)

    node.interrupt()
    assert node.wait(2.0) == 0
    robot.spin_for(0.1)
    assert feed.commands[-1].voltage == 0.0


def test_parameter_change_is_atomic_and_bumpless(start, robot, eventually):
    patient = ("setpoint_timeout:=30.0", "feedback_timeout:=10.0")
    node = start("p:=2.0", "i:=10.0", "u_clamp_max:=12.0", *patient)
    feed = Feed(robot, eventually)
    settle(robot, feed)
    assert robot.set(NODE, p=2.0)[0]  # from here on the service is known
    eventually(lambda: feed.sample(0.0) > 0.0, 5.0, lambda: robot.send_setpoint(1.0))
    for _ in range(20):
        feed.sample(0.5)
    for values, words in (
        (dict(p=math.nan), "p is nan"),
        (dict(p=5.0, u_clamp_max=-20.0, u_clamp_min=-10.0), "u_clamp_m"),
        (dict(setpoint_timeout=-1.0), "setpoint_timeout"),
        (dict(antiwindup_strategy="hope"), "antiwindup_strategy"),
        (dict(speed_source="observer"), "model.dc_gain"),
        (dict(p="five"), "p is 'five'"),
        (dict(observer__load=-1.0), "load"),
    ):
        feed.sample(0.5)  # stamped now: a busy machine takes its time for a call
        before = feed.sample(0.5, 0.01)
        accepted, reason = robot.set(NODE, **values)
        assert not accepted and words in reason
        assert feed.sample(0.5, 0.01) - before == pytest.approx(10.0 * 0.5 * 0.01, abs=1e-6)
    feed.sample(0.5)
    before = feed.sample(0.5, 0.01)
    assert robot.set(NODE, p=4.0, i=5) == (True, "")
    after = feed.sample(0.5, 0.01)
    assert after - before == pytest.approx(10.0 * 0.5 * 0.01, abs=1e-6), "the output jumped"
    assert feed.sample(0.5, 0.01) - after == pytest.approx(5.0 * 0.5 * 0.01, abs=1e-6)
    node.send_signal(signal.SIGTERM)
    assert node.wait(2.0) == 0
    robot.spin_for(0.1)
    assert feed.commands[-1].voltage == 0.0


def test_stall_runaway_and_over_current_switch_the_motor_off(start, robot, eventually):
    start(
        "p:=10.0", "u_clamp_max:=12.0", "u_clamp_min:=-12.0", "current_limit:=2.0",
        "stall_time:=0.2", "setpoint_timeout:=30.0", "fault_retry:=0.0",
    )  # fmt: skip
    feed = Feed(robot, eventually)
    settle(robot, feed)
    for words, velocity, current in (
        ("no counts under voltage", 0.0, math.nan),
        ("runaway", -0.5, math.nan),
        ("over-current", 0.4, 3.0),
    ):
        robot.setpoint = 1.0
        begin = time.monotonic()
        eventually(lambda v=velocity: feed.sample(v) > 1.0, 3.0, message=f"before {words}")
        eventually(lambda v=velocity, i=current: feed.sample(v, current=i) == 0.0, 1.0)
        eventually(lambda w=words, t=begin: robot.named(NODE, w, t), 1.0, robot.spin)
        assert feed.sample(velocity) == 0.0
        robot.setpoint = 0.0
        eventually(
            lambda: feed.sample(0.0) == 0.0 and robot.last_diagnosis(NODE).startswith("driving"),
            5.0,
            message="not released by a zero set-point",
        )


def test_unknown_parameter_and_missing_gains_cause_warnings(start, eventually):
    node = start("max_velocty:=1.0")
    eventually(lambda: "default gains: p is 1 V s/rad" in node.output, 5.0)
    words = "unknown parameter 'max_velocty' is ignored; did you mean 'max_velocity'?"
    eventually(lambda: words in node.output, 5.0)


def test_latched_runaway_is_cleared_only_by_reset(start, robot, eventually):
    start("p:=10.0", "setpoint_timeout:=30.0", "fault_retry:=0.05")
    feed = Feed(robot, eventually)
    settle(robot, feed)
    robot.setpoint = 1.0
    tried: list[float] = []

    def latched() -> bool:
        tried.append(feed.sample(-0.5))
        return "runaway" in robot.last_diagnosis(NODE) and "latched" in robot.last_diagnosis(NODE)

    eventually(lambda: robot.named(NODE, "runaway") or latched(), 5.0, message="no runaway")
    tried.clear()
    eventually(latched, 15.0, message="not latched")
    assert max(tried) <= 4.2 + 1e-9, "more than the small voltage of a try"
    robot.setpoint = 0.0
    robot.spin_for(0.7)
    robot.setpoint = 1.0
    for _ in range(20):
        assert feed.sample(0.5) == 0.0
    assert "runaway" in robot.trigger(NODE, "reset")
    eventually(lambda: feed.sample(0.5) != 0.0, 3.0)


def real_time_is_granted() -> bool:
    """Return whether SCHED_FIFO is granted, tried in a separate process."""
    asked = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))"
    return subprocess.run([sys.executable, "-c", asked], capture_output=True).returncode == 0


def test_priority_and_cpu_affinity_apply_to_all_threads(start, robot, eventually):
    processor = min(os.sched_getaffinity(0))
    node = start("scheduling_priority:=10", f"cpu_affinity:=[{processor}]")
    settle(robot, Feed(robot, eventually))
    threads = [int(name) for name in os.listdir(f"/proc/{node.pid}/task")]
    assert len(threads) > 1, "the middleware has threads of its own"
    assert {tuple(os.sched_getaffinity(thread)) for thread in threads} == {(processor,)}
    if real_time_is_granted():
        assert {os.sched_getscheduler(thread) for thread in threads} == {os.SCHED_FIFO}
    else:
        eventually(lambda: robot.named(NODE, "scheduling_priority 10 not granted"), 3.0, robot.spin)


def test_nonexistent_cpu_is_reported_and_ignored(start, robot, eventually):
    start("cpu_affinity:=[4000]")
    settle(robot, Feed(robot, eventually))
    eventually(lambda: robot.named(NODE, "cpu_affinity [4000] is not granted"), 3.0, robot.spin)
