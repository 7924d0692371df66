# SPDX-License-Identifier: Apache-2.0
"""Repeat benchmarks/observer.py on live nodes: motor_plant and one wheel_pid.

The plant reports the true speed (velocity_window 0), which the loop does not use; wheel_pid
makes its speed from counts, differenced over one sample or observed, with the same gains. Its
model is the plant's own with every number wrong by 1 %. The reference goes up and down a ramp,
so that counts cannot lock to the sampling. Voltage noise is the deviation of the command from its
mean over 0.1 s.

    python benchmarks/observer_live.py [--rates 200 1000] [--duration 8]
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState

from smp_interfaces.msg import MotorState, PidState
from smp_motor_control.motor.file import MotorEntry, load_motors
from smp_motor_control.nodes import runtime

ROOT = Path(__file__).resolve().parent.parent
WHEEL = "front_left"
BANDWIDTH = {200.0: 25.0, 1000.0: 40.0}
DOMAIN = 97


def parameters(entry: MotorEntry, rate: float, source: str) -> list[str]:
    """Return the command line of wheel_pid: PI at the bandwidth, and the observer's model."""
    p, ratio = entry.parameters, entry.gearbox.ratio
    bandwidth = BANDWIDTH[rate]
    values = {
        "p": p.a1 * bandwidth * ratio,
        "i": p.a0 * bandwidth * ratio,
        "d": 0.0,
        "feedforward_velocity": p.a0 * ratio,
        "antiwindup_strategy": "conditional_integration",
        "max_acceleration": 0.5,
        "stop_time": 10.0,
        "speed_source": source,
        "difference_window": 1,
        "model.dc_gain": 1.01 * p.dc_gain,
        "model.time_constant": 0.99 * p.time_constant,
        "model.time_constant_product": 1.01 * p.time_constant_product,
        "model.static_voltage": 0.99 * p.static_voltage,
    }
    arguments = ["--ros-args", "-r", f"__ns:=/{WHEEL}"]
    for name, value in values.items():
        arguments += ["-p", f"{name}:={value}"]
    return arguments


class Probe:
    """Set the wheel's speed and store the nodes' messages."""

    def __init__(self) -> None:
        rclpy.init(args=[], domain_id=DOMAIN)
        self.node = rclpy.create_node("probe")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.truth: dict[float, float] = {}
        self.pid: list[tuple[float, float, float]] = []
        qos = runtime.STREAM_SUBSCRIBER
        self.node.create_subscription(MotorState, f"/{WHEEL}/motor_state", self._on_state, qos)
        self.node.create_subscription(PidState, f"/{WHEEL}/pid_state", self._on_pid, qos)
        self.setpoints = self.node.create_publisher(JointState, "/wheel_setpoints", 5)

    def _on_state(self, message: MotorState) -> None:
        self.truth[runtime.seconds(message.header.stamp)] = message.velocity

    def _on_pid(self, message: PidState) -> None:
        stamp = runtime.seconds(message.header.stamp)
        self.pid.append((stamp, message.measurement, message.output))

    def drive(self, duration: float) -> None:
        begin = last = time.monotonic()
        while (now := time.monotonic()) - begin < duration:
            if now - last > 0.05:
                last = now
                speed = 0.9 if (now - begin) % 2.6 < 1.3 else 1.5
                self.setpoints.publish(JointState(name=[f"{WHEEL}_wheel_joint"], velocity=[speed]))
            self.executor.spin_once(timeout_sec=0.02)


def measure(entry: MotorEntry, rate: float, source: str, duration: float) -> tuple[float, float]:
    """Run plant and controller; return the errors of speed [rad/s, motor] and voltage [V]."""
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(DOMAIN),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    plant = ["motor_plant", "--ros-args", "-p", f"rate:={rate}", "-p", "velocity_window:=0"]
    plant += ["-p", f"motors_file:={ROOT / 'config' / 'motors_paper.yaml'}"]
    commands = [plant, ["wheel_pid", *parameters(entry, rate, source)]]
    started = [subprocess.Popen(command, env=environment) for command in commands]
    probe = Probe()
    try:
        probe.drive(4.0)
        probe.truth.clear()
        probe.pid.clear()
        probe.drive(duration)
    finally:
        for process in started:
            process.send_signal(signal.SIGINT)
        for process in started:
            process.wait(5.0)
        probe.executor.shutdown()
        probe.node.destroy_node()
        rclpy.shutdown()
    rows = np.array([(m - probe.truth[t], u) for t, m, u in probe.pid if t in probe.truth])
    if len(rows) < 0.5 * rate * duration:
        raise SystemExit(f"only {len(rows)} samples of {rate * duration:g} arrived: busy machine")
    width = max(int(0.1 * rate), 3)
    slow = np.convolve(rows[:, 1], np.ones(width) / width, mode="valid")
    inner = rows[width // 2 : width // 2 + len(slow), 1]
    to_motor = entry.gearbox.ratio
    return float(np.sqrt(np.mean(rows[:, 0] ** 2))) * to_motor, float(np.std(inner - slow))


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rates", type=float, nargs="+", default=[200.0, 1000.0])
    parser.add_argument("--duration", type=float, default=8.0)
    arguments = parser.parse_args(argv)
    entry = load_motors(ROOT / "config" / "motors_paper.yaml")[WHEEL]
    print("rate [Hz]  source       speed error [rad/s]  voltage noise [V]")
    worst = 0.0
    for rate in arguments.rates:
        found = {}
        for source in ("difference", "observer"):
            found[source] = measure(entry, rate, source, arguments.duration)
            speed, voltage = found[source]
            print(f"{rate:9g}  {source:11}  {speed:19.3f}  {voltage:17.4f}", flush=True)
        ratios = [b / a for a, b in zip(found["difference"], found["observer"], strict=True)]
        worst = max(worst, *ratios)
        print(f"{rate:9g}  ratio        {ratios[0]:19.2f}  {ratios[1]:17.2f}", flush=True)
    print(f"largest ratio {worst:.2f} (asked for: at most 0.50)")
    return 0 if worst <= 0.5 else 1


if __name__ == "__main__":
    raise SystemExit(main())
