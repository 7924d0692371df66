# SPDX-License-Identifier: Apache-2.0
"""Repeat benchmarks/together.py on live nodes: motor_plant, four wheel_pid, DDS.

The motors are identified from a recorded bag (see benchmarks/together.py), the gains and the
common reference designed by ``design_wheels`` from that, written as ``tune`` writes them, and
loaded by the nodes.  Steps from rest to 100 rad/s of the motors and back to rest; the true
speed, which the loop does not use, is that of the plant (velocity_window 0).

    python benchmarks/together_live.py [--rates 100 200 1000] [--steps 6]

A step during which a sample or the answer to it came late by more than 0.7 of the period, or
not at all, is noted as disturbed: the machine ran something else then.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from together import ENTRIES, SPEED, identify_recorded, settling_time

from smp_interfaces.msg import MotorState, PidState
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.executor import LeanExecutor
from smp_motor_ident.tune import Design, Loop, design_wheels
from smp_motor_ident.tune.writing import gains_yaml

DOMAIN = 98
HOLD = 0.9
"""How long a speed is asked for [s]."""

SETPOINTS = 0.02
"""Interval of the set-points [s]."""

LATE = 1.7
"""Periods: a longer interval between samples, or to an answer, tells of a disturbed step."""


@dataclass(frozen=True)
class Step:
    """Settling and overshoot of the wheels in one step.

    Attributes
    ----------
    settling : dict of str to float
        From the sample at which the wheel was first asked [s].
    spread : float
        Between the instants at which first and last wheel settled [s].
    overshoot : float
        Largest of all wheels [%].
    interval : float
        Longest between two samples of any wheel, or from a sample to the answer to the one after
        it, in periods.
    """

    settling: dict[str, float]
    spread: float
    overshoot: float
    interval: float


class Probe:
    """Give all wheels the same set-point, and store their speeds."""

    def __init__(self, wheels: Sequence[str]) -> None:
        rclpy.init(args=[], domain_id=DOMAIN)
        self.node = rclpy.create_node("probe")
        self.executor = LeanExecutor()
        self.executor.add_node(self.node)
        # As bytes, read afterwards: thousands a second come at 1 kHz.
        self.states: dict[str, list[bytes]] = {w: [] for w in wheels}
        self.asked: dict[str, list[bytes]] = {w: [] for w in wheels}
        qos = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
        for wheel in wheels:
            for kind, name, seen in (
                (MotorState, "motor_state", self.states), (PidState, "pid_state", self.asked),
            ):  # fmt: skip
                self.node.create_subscription(
                    kind, f"/{wheel}/{name}", seen[wheel].append, qos, raw=True
                )
        self.setpoints = self.node.create_publisher(JointState, "/wheel_setpoints", 1)
        self.speed = 0.0
        runtime.steady_timer(self.node, SETPOINTS, self._ask)

    def _ask(self) -> None:
        names = [f"{wheel}_wheel_joint" for wheel in self.states]
        self.setpoints.publish(JointState(name=names, velocity=[self.speed] * len(names)))

    def drive(self, speed: float, duration: float) -> None:
        """Ask for a speed for some time."""
        self.speed = speed
        end = time.monotonic() + duration
        while time.monotonic() < end:
            self.executor.spin_once()

    def forget(self) -> None:
        """Take pending messages and drop them."""
        self.catch_up()
        for seen in (*self.states.values(), *self.asked.values()):
            seen.clear()

    def catch_up(self) -> None:
        """Spin until all messages sent so far have arrived."""
        now = runtime.seconds(self.node.get_clock().now().to_msg())
        end = time.monotonic() + 5.0
        while time.monotonic() < end and not all(
            seen and _stamp(seen[-1], kind) > now
            for kind, of in ((MotorState, self.states), (PidState, self.asked))
            for seen in of.values()
        ):
            self.executor.spin_once()

    def step(self, target: float, period: float) -> Step:
        """Read a step that began after the last :meth:`forget`."""
        self.catch_up()
        settling, instants, overshoot, longest = {}, [], 0.0, 0.0
        for wheel, seen in self.states.items():
            states = [deserialize_message(data, PidState) for data in self.asked[wheel]]
            states = [m for m in states if m.setpoint == target]
            begin = runtime.seconds(states[0].header.stamp)
            answered = np.array([runtime.seconds(m.header.stamp) for m in states])
            states = [deserialize_message(data, MotorState) for data in seen]
            stamps = np.array([runtime.seconds(m.header.stamp) for m in states])
            speed = np.array([m.velocity for m in states])[stamps > begin - 2 * period]
            stamps = stamps[stamps > begin - 2 * period]
            late = max(float(np.diff(answered).max()), period + max(m.age for m in states))
            at = settling_time(stamps, speed / target)
            settling[wheel] = at - begin
            instants.append(at)
            overshoot = max(overshoot, 100.0 * (speed.max() / target - 1.0))
            longest = max(longest, float(np.diff(stamps).max()) / period, late / period)
        return Step(settling, max(instants) - min(instants), overshoot, longest)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown()


def _stamp(data: bytes, kind: Any) -> float:
    return runtime.seconds(deserialize_message(data, kind).header.stamp)


def designed(rate: float, seed: int) -> Mapping[str, Design]:
    """Identify from a bag, and design for live nodes: the driver latches at its own rate."""
    found = identify_recorded(ENTRIES, min(rate, 200.0), seed)
    source = "difference" if rate < 500.0 else "observer"
    loop = Loop(sample_time=1.0 / rate, speed_source=source)
    return design_wheels(found, dict.fromkeys(found, loop), max_velocity=2.0).designs


def measure(rate: float, steps: int, seed: int, priority: int) -> tuple[list[Step], float]:
    """Run the nodes and step; return the result of each step, and the transition [s]."""
    designs = designed(rate, seed)
    environment = {
        **os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        gains = Path(folder) / "gains.yaml"
        gains.write_text(gains_yaml(designs, ["Of benchmarks/together_live.py."]))
        motors = Path(__file__).resolve().parent.parent / "config" / "motors_paper.yaml"
        commands = [["motor_plant", "--ros-args", "-p", f"rate:={rate}", "-p", "velocity_window:=0",
                     "-p", f"motors_file:={motors}"]]  # fmt: skip
        commands += [["wheel_pid", "--ros-args", "-r", f"__ns:=/{wheel}", "--params-file", gains]
                     for wheel in designs]  # fmt: skip

        def prefer() -> None:
            if priority:
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))

        started = [subprocess.Popen(c, env=environment, preexec_fn=prefer) for c in commands]
        probe = Probe(list(designs))
        target = SPEED / next(iter(designs.values())).loop.gear_ratio
        found = []
        try:
            probe.drive(target, 5.0)
            probe.drive(0.0, HOLD)
            for _ in range(steps):
                probe.forget()
                probe.drive(target, HOLD)
                found.append(probe.step(target, 1.0 / rate))
                probe.drive(0.0, HOLD)
        finally:
            for process in started:
                process.send_signal(signal.SIGINT)
            for process in started:
                process.wait(10.0)
            probe.close()
    return found, max(one.reference.transition_time for one in designs.values())


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rates", type=float, nargs="+", default=[100.0, 200.0, 1000.0])
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument(
        "--priority", type=int, default=0, help="SCHED_FIFO priority of the nodes; 0 for none"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the recording")
    arguments = parser.parse_args(argv)
    print("rate [Hz]  transition [ms]  settling [ms]                  spread [ms]  overshoot [%]")
    for rate in arguments.rates:
        steps, transition = measure(rate, arguments.steps, arguments.seed, arguments.priority)
        for one in steps:
            times = "  ".join(f"{1e3 * t:6.1f}" for t in one.settling.values())
            words = (
                "" if one.interval < LATE else f"  disturbed: a sample {one.interval:.1f} periods"
            )
            print(
                f"{rate:9g}  {1e3 * transition:15.0f}  {times}  {1e3 * one.spread:11.1f}  "
                f"{one.overshoot:13.2f}{words}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
