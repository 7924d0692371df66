# SPDX-License-Identifier: Apache-2.0
"""Drive plant, four wheel controllers and skid_steer at 200 Hz for a long time.

    python benchmarks/soak.py               # 20 minutes
    python benchmarks/soak.py --minutes 2

Looks at the memory of every process (flat within 1 MiB after the first minute), at watchdogs
(none may bite), and at the period of the loop (its mean may not drift).  Exit code 1 where one
of these does not hold.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
MEMORY_LIMIT = 1 << 20
SETTLED = 60.0
DRIFT_LIMIT = 1e-5
"""Of the period between the first and the last third; crystals are a tenth of that."""
RATE = 200.0


def start() -> dict[str, subprocess.Popen[bytes]]:
    """Start all nodes of the robot."""
    from smp_motor_control import WHEELS

    gains = ROOT / "config" / "gains.yaml"
    commands = {
        "motor_plant": ["motor_plant", "--ros-args", "-p", f"rate:={RATE}"],
        "skid_steer": ["skid_steer", "--ros-args", "--params-file",
                       str(ROOT / "config" / "skid_steer.yaml")],
    }  # fmt: skip
    for wheel in WHEELS:
        commands[f"{wheel}/wheel_pid"] = [
            "wheel_pid", "--ros-args", "-r", f"__ns:=/{wheel}", "--params-file", str(gains)
        ]  # fmt: skip
    return {name: subprocess.Popen(command) for name, command in commands.items()}


def resident(pid: int) -> int:
    """Return the anonymous memory of a process [bytes]; shared memory of DDS is not its own."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon"):
            return 1024 * int(line.split()[1])
    raise SystemExit(f"process {pid} has ended")


class Driver:
    """Drives the robot and records problems."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import TwistStamped

        from smp_interfaces.msg import PidState
        from smp_motor_control import WHEELS
        from smp_motor_control.nodes.executor import LeanExecutor
        from smp_motor_control.nodes.runtime import STREAM_SUBSCRIBER, steady_timer

        rclpy.init(args=[])
        self.node = rclpy.create_node("soak_driver")
        self.command = TwistStamped()
        self.publisher = self.node.create_publisher(TwistStamped, "/cmd_vel", 1)
        self.begin = time.monotonic()
        self.stamps: dict[str, list[float]] = {wheel: [] for wheel in WHEELS}
        self.ages: list[float] = []
        self.trouble: dict[str, int] = {}
        for wheel in WHEELS:
            self.node.create_subscription(
                PidState,
                f"/{wheel}/pid_state",
                lambda message, kept=self.stamps[wheel]: self.step(message, kept),
                STREAM_SUBSCRIBER,
            )
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnosed, 100)
        self.timer = steady_timer(self.node, 0.05, self.drive)
        self.executor = LeanExecutor()
        self.executor.add_node(self.node)
        self.counting = False

    def drive(self) -> None:
        """Wander about, never at rest."""
        t = time.monotonic() - self.begin
        self.command.header.stamp = self.node.get_clock().now().to_msg()
        self.command.twist.linear.x = 0.12 + 0.04 * math.sin(0.3 * t)
        self.command.twist.angular.z = 0.1 * math.sin(0.17 * t)
        self.publisher.publish(self.command)

    def step(self, message: object, kept: list[float]) -> None:
        """Keep when a loop stepped."""
        if self.counting:
            kept.append(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
            self.ages.append(message.age)

    def diagnosed(self, array: object) -> None:
        """Count everything that is worse than all right."""
        for status in array.status if self.counting else ():
            if status.level != b"\x00":
                report = f"{status.name}: {status.message}"
                self.trouble[report] = self.trouble.get(report, 0) + 1

    def spin(self, seconds: float) -> None:
        """Drive for some time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once()


def soak(minutes: float, processes: dict[str, subprocess.Popen[bytes]]) -> bool:
    """Drive, watch, and print the findings."""
    driver = Driver()
    driver.spin(10.0)
    driver.counting = True
    memory: dict[str, list[int]] = {name: [] for name in processes}
    begin = time.monotonic()
    while (elapsed := time.monotonic() - begin) < 60.0 * minutes:
        for name, process in processes.items():
            memory[name].append(resident(process.pid))
        total = sum(m[-1] for m in memory.values()) / (1 << 20)
        print(f"\r{elapsed / 60:5.1f} of {minutes:g} min, {total:.1f} MiB", end="", flush=True)
        driver.spin(5.0)
    print()
    held = True
    first = int(SETTLED / 5.0)
    for name, samples in memory.items():
        settled = samples[first:] or samples[-1:]
        growth = settled[-1] - settled[0]
        spread = max(settled) - min(settled)
        held &= spread <= MEMORY_LIMIT
        print(
            f"{name:24s} memory {settled[-1] / (1 << 20):6.1f} MiB, after the first minute grown "
            f"by {growth / 1024:+.0f} KiB, spread {spread / 1024:.0f} KiB"
        )
    for wheel, stamps in driver.stamps.items():
        held &= _period_holds(wheel, np.array(stamps))
    ages = 1e3 * np.array(driver.ages)
    p50, p99 = np.percentile(ages, [50, 99])
    print(f"age of feedback: p50 {p50:.2f} ms, p99 {p99:.2f} ms")
    for report, count in driver.trouble.items():
        print(f"{count} x {report}")
    if not driver.trouble:
        print("no watchdog has bitten, nothing was worse than all right")
    return held and not driver.trouble


def _period(stamps: np.ndarray) -> float:
    """Return the slope of the stamps over their number, samples that were left out counted."""
    number = np.round((stamps - stamps[0]) * RATE)
    return float(np.polyfit(number, stamps - stamps[0], 1)[0])


def _period_holds(wheel: str, stamps: np.ndarray) -> bool:
    """Compare the period of the first and the last third."""
    third = len(stamps) // 3
    early, late = _period(stamps[:third]), _period(stamps[-third:])
    drift = late / early - 1.0
    steps = np.diff(stamps)
    missed = int(np.round((stamps[-1] - stamps[0]) * RATE)) + 1 - len(stamps)
    print(
        f"{wheel:24s} period {1e3 * early:.6f} ms early, {1e3 * late:.6f} ms late: drift "
        f"{drift:+.1e}; longest {1e3 * steps.max():.1f} ms, {missed} of {len(stamps)} missed"
    )
    return abs(drift) <= DRIFT_LIMIT


def main() -> int:
    """Run the soak."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=20.0)
    arguments = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", "97")
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    processes = start()
    try:
        held = soak(arguments.minutes, processes)
    finally:
        for process in processes.values():
            process.send_signal(signal.SIGINT)
        codes = {name: process.wait(10) for name, process in processes.items()}
    print("exit codes:", json.dumps(codes))
    return 0 if held and not any(codes.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
