# SPDX-License-Identifier: Apache-2.0
"""Timing of ``wheel_pid`` against a bare node that only echoes, in one run.

    python benchmarks/timing.py                 # everything, about four minutes
    python benchmarks/timing.py --only echo     # ratios against the bare node
    python benchmarks/timing.py --only wheels   # four wheels at 500 Hz for 60 s
    python benchmarks/timing.py --only core     # one PID step
    python benchmarks/timing.py --only wheels --priority 0   # without real-time priority

The feeder publishes ``motor_state`` at a fixed rate and takes the time until the middleware has
received the command that answers it.  An answer is late when the next sample was sent before.
Echo and controller run in turn, several times; medians are reported.  The four wheels run with
``scheduling_priority`` where the system grants it, the feeder one below: a controller comes
before whoever feeds it.
"""

from __future__ import annotations

import argparse
import gc
import math
import os
import signal
import statistics
import subprocess
import sys
import time
import timeit
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import stillness
from stillness import Witness, touched

CPU_LIMIT, LATENCY_LIMIT, ANSWERED_LIMIT, STEP_LIMIT = 1.4, 1.3, 0.999, 3e-6
GAINS = {
    "p": 2.0,
    "i": 50.0,
    "d": 0.05,
    "derivative_filter_time_constant": 0.005,
    "u_clamp_min": -12.0,
    "u_clamp_max": 12.0,
    "antiwindup_strategy": "back_calculation",
    "feedforward_static": 0.4,
    "feedforward_velocity": 2.5,
    "feedforward_acceleration": 0.1,
    "transition_time": 0.2,
    "stall_time": 0.0,
    "runaway_time": 0.0,
}


def echo(priority: int) -> None:
    """Run a bare node: the minimum work of rclpy per sample."""
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions

    from smp_interfaces.msg import MotorCommand, MotorState
    from smp_motor_control.nodes.runtime import STREAM_PUBLISHER, STREAM_SUBSCRIBER

    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    node = Node("wheel_pid", start_parameter_services=False)
    publisher = node.create_publisher(MotorCommand, "motor_command", STREAM_PUBLISHER)
    command = MotorCommand()

    def answer(message: MotorState) -> None:
        command.header.stamp = message.header.stamp
        command.voltage = message.velocity
        publisher.publish(command)

    node.create_subscription(MotorState, "motor_state", answer, STREAM_SUBSCRIBER)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin()


@dataclass
class Result:
    """Of one process under one feed."""

    cpu: float
    p50: float
    p99: float
    answered: float


class Feeder:
    """Publishes feedback and set-points of some wheels and notes when the answers came in.

    The middleware stamps an answer on arrival; the feeder takes them between two ticks, so it does
    not disturb the measured nodes.
    """

    def __init__(self, wheels: list[str]) -> None:
        import rclpy
        from sensor_msgs.msg import JointState

        from smp_interfaces.msg import MotorCommand, MotorState
        from smp_motor_control.nodes.runtime import STREAM_PUBLISHER, STREAM_SUBSCRIBER

        rclpy.init(args=[])
        self.node = rclpy.create_node("feeder", start_parameter_services=False)
        self.wheels = wheels
        self.sent: dict[str, list[int]] = {wheel: [] for wheel in wheels}
        self.received: dict[str, dict[int, int]] = {wheel: {} for wheel in wheels}
        self.messages = {wheel: MotorState() for wheel in wheels}
        self.states = {
            wheel: self.node.create_publisher(MotorState, f"/{wheel}/motor_state", STREAM_PUBLISHER)
            for wheel in wheels
        }
        self.commands = {
            wheel: self.node.create_subscription(
                MotorCommand, f"/{wheel}/motor_command", lambda message: None, STREAM_SUBSCRIBER
            )
            for wheel in wheels
        }
        self.command_type = MotorCommand
        self.setpoints = self.node.create_publisher(
            JointState, "/wheel_setpoints", STREAM_PUBLISHER
        )
        self.setpoint = JointState(
            name=[f"{w}_wheel_joint" for w in wheels], velocity=[1.0] * len(wheels)
        )

    def take(self) -> None:
        """Note when the middleware received each answer, by the stamp that it carries."""
        for wheel, subscription in self.commands.items():
            received = self.received[wheel]
            while taken := subscription.handle.take_message(self.command_type, False):
                stamp = taken[0].header.stamp
                at = stamp.sec * 1_000_000_000 + stamp.nanosec
                received[at] = taken[1]["received_timestamp"]

    def feed(self, rate: float, duration: float) -> None:
        """Publish at a rate; the sample after a late one follows a whole period later."""
        due = time.perf_counter()
        for tick in range(round(duration * rate)):
            due += 1.0 / rate
            time.sleep(max(0.0, due - time.perf_counter()))
            late = time.perf_counter() - due
            if late > 0.1 / rate:
                due += late
            self.take()
            self.publish(tick % max(1, round(rate / 20)) == 0)
        time.sleep(0.2)
        self.take()

    def publish(self, with_setpoint: bool) -> None:
        """Publish one sample of every wheel."""
        if with_setpoint:
            self.setpoints.publish(self.setpoint)
        for wheel in self.wheels:
            message = self.messages[wheel]
            message.encoder_count += 1
            message.velocity = 0.9 + 0.1 * math.sin(message.encoder_count * 0.01)
            now = time.time_ns()
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(now, 1_000_000_000)
            self.sent[wheel].append(now)
            self.states[wheel].publish(message)

    def ready(self, rate: float) -> None:
        """Feed until every wheel answers, and a second longer."""
        deadline = time.perf_counter() + 30.0
        while not all(self.controls(wheel) for wheel in self.wheels):
            if time.perf_counter() > deadline:
                raise SystemExit("a controller does not answer")
            self.feed(rate, 0.5)
        self.feed(rate, 1.0)
        self.forget()

    def controls(self, wheel: str) -> bool:
        """Return whether the last samples were answered, and not by a zero on its own account."""
        last = self.sent[wheel][-20:-2]
        return bool(last) and all(at in self.received[wheel] for at in last)

    def forget(self) -> None:
        """Begin anew."""
        for wheel in self.wheels:
            self.sent[wheel].clear()
            self.received[wheel].clear()

    def times(self, wheel: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return when samples were sent and the ones after them [ns], and the answers' time [s].

        NaN where no answer came.  The first sample, which follows a pause, is left out.
        """
        sent, received = self.sent[wheel][1:], self.received[wheel]
        took = [1e-9 * (received.get(at, math.nan) - at) for at in sent[:-1]]
        return np.array(sent[:-1]), np.array(sent[1:]), np.array(took)


def start(kind: str, wheel: str, priority: int = 0) -> subprocess.Popen[bytes]:
    """Start the echo or the controller of one wheel."""
    if kind == "echo":
        command = [sys.executable, str(Path(__file__).resolve()), "--echo", str(priority)]
        command.append("--ros-args")
    else:
        given = [f"{name}:={value}" for name, value in GAINS.items()]
        given.append(f"scheduling_priority:={priority}")
        command = ["wheel_pid", "--ros-args", *(a for g in given for a in ("-p", g))]
    return subprocess.Popen([*command, "-r", f"__ns:=/{wheel}"])


def cpu_seconds(pid: int) -> float:
    """Return the processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(feeder: Feeder, kind: str, rate: float, duration: float, priority: int = 0) -> Result:
    """Run one kind of node under the feed."""
    witness = Witness() if priority else None
    still = np.empty((0, 2), dtype=np.int64)
    processes = [start(kind, wheel, priority) for wheel in feeder.wheels]
    try:
        feeder.forget()
        feeder.ready(rate)
        before = [cpu_seconds(p.pid) for p in processes]
        feeder.feed(rate, duration)
        used = [cpu_seconds(p.pid) - b for p, b in zip(processes, before)]
    finally:
        for process in processes:
            process.send_signal(signal.SIGKILL if kind == "echo" else signal.SIGINT)
        for process in processes:
            process.wait(10)
        if witness is not None:
            still = witness.stop()
    sent, after, took = (np.concatenate(part) for part in zip(*map(feeder.times, feeder.wheels)))
    answered = sent + 1e9 * took < after
    if priority and not answered.all():
        within = touched(sent, after, still)
        print(
            f"  {np.count_nonzero(~answered)} of {took.size} not in time, longest "
            f"{1e3 * np.nanmax(took):.1f} ms; {np.count_nonzero(~answered & within)} of them while "
            f"the machine stood still; in time otherwise {100 * answered[~within].mean():.3f} %"
        )
    return Result(
        cpu=sum(used) / duration / len(used),
        p50=float(np.nanpercentile(took, 50)),
        p99=float(np.nanpercentile(took, 99)),
        answered=answered.mean(),
    )


def compare(rate: float, duration: float, repeats: int) -> bool:
    """Measure echo and controller in turn and print their ratios."""
    feeder = Feeder(["front_left"])
    runs: dict[str, list[Result]] = {"echo": [], "wheel_pid": []}
    for k in range(repeats):
        for kind in sorted(runs, reverse=bool(k % 2)):
            result = measure(feeder, kind, rate, duration)
            runs[kind].append(result)
            print(
                f"  {kind:10s} {rate:g} Hz: cpu {100 * result.cpu:5.1f} %, "
                f"p50 {1e3 * result.p50:.3f} ms, p99 {1e3 * result.p99:.3f} ms, "
                f"answered in time {100 * result.answered:.2f} %",
                flush=True,
            )
    held = True
    for name, limit in (("cpu", CPU_LIMIT), ("p50", LATENCY_LIMIT), ("p99", LATENCY_LIMIT)):
        echoed, controlled = (
            statistics.median(getattr(r, name) for r in runs[kind]) for kind in runs
        )
        ratio = controlled / echoed
        held &= ratio <= limit
        print(f"{name} at {rate:g} Hz: {ratio:.2f} times the bare node's, limit {limit}")
    return held


def real_time_granted() -> bool:
    """Return whether this process may ask for SCHED_FIFO."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(stillness.PRIORITY))
    except OSError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def wheels(rate: float, duration: float, priority: int) -> bool:
    """Measure four wheels and four bare nodes at once, with the feeder at a lower priority."""
    from smp_motor_control import WHEELS
    from smp_motor_control.nodes.wheel_pid import request_real_time

    if priority and not real_time_granted():
        print("  the system grants no real-time priority: running without")
        priority = 0
    feeder = Feeder(list(WHEELS))
    request_real_time(feeder.node, max(0, priority - 1), ())
    results = {
        kind: measure(feeder, kind, rate, duration, priority) for kind in ("echo", "wheel_pid")
    }
    for kind, result in results.items():
        print(
            f"four {kind} at {rate:g} Hz for {duration:g} s, "
            f"priority {priority or 'none'}: {100 * result.answered:.3f} % "
            f"answered before the next sample (p50 {1e3 * result.p50:.2f} ms, "
            f"p99 {1e3 * result.p99:.2f} ms, cpu {100 * result.cpu:.1f} % each)"
        )
    print(f"limit for wheel_pid: {100 * ANSWERED_LIMIT} %")
    return results["wheel_pid"].answered >= ANSWERED_LIMIT


def core() -> bool:
    """Measure one step of the PID, and of the whole loop around it."""
    from smp_motor_control.pid import Pid, PidGains
    from smp_motor_control.wheel.loop import LoopSettings, WheelLoop

    names = PidGains.__dataclass_fields__
    gains = PidGains(**{k: v for k, v in GAINS.items() if k in names})
    pid, loop = Pid(gains), WheelLoop(LoopSettings(gains=gains, transition_time=0.2))
    gc.disable()
    count = 100_000
    step = min(timeit.repeat(lambda: pid.step(1.0, 0.9, 0.002), number=count, repeat=7)) / count
    whole = min(timeit.repeat(lambda: loop.step(1.0, 0.9, 0.002), number=count, repeat=7)) / count
    print(f"PID step: {1e6 * step:.2f} us, limit {1e6 * STEP_LIMIT:g} us; ", end="")
    print(f"with the reference: {1e6 * whole:.2f} us")
    return step <= STEP_LIMIT


def main() -> int:
    """Run the measurements; exit code 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=("echo", "wheels", "core"))
    parser.add_argument("--rate", type=float, default=500.0, help="of the comparison [Hz]")
    parser.add_argument("--duration", type=float, default=10.0, help="of each run [s]")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--wheels-duration", type=float, default=60.0)
    parser.add_argument(
        "--priority", type=int, default=50, help="SCHED_FIFO of the four wheels; 0 for none"
    )
    arguments = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", "98")
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    if arguments.only is None:  # one rclpy context per process
        parts = ("core", "echo", "wheels")
        common = sys.argv[1:]
        codes = [
            subprocess.call([sys.executable, __file__, "--only", part, *common]) for part in parts
        ]
        return max(codes)
    held = {
        "core": core,
        "echo": lambda: compare(arguments.rate, arguments.duration, arguments.repeats),
        "wheels": lambda: wheels(500.0, arguments.wheels_duration, arguments.priority),
    }[arguments.only]()
    return 0 if held else 1


if __name__ == "__main__":
    if "--echo" in sys.argv:
        at = sys.argv.index("--echo")
        priority = int(sys.argv[at + 1])
        del sys.argv[at : at + 2]
        echo(priority)
    else:
        sys.exit(main())
