# SPDX-License-Identifier: Apache-2.0
"""Steps of the tools that work on a running robot: record, excite, run another tool."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from smp_motor_control import get_controller_name
from smp_motor_ident.bag import writer  # noqa: F401  (a missing package is reported at once)
from smp_motor_ident.cli import tables  # noqa: F401
from smp_motor_ident.cli.frame import INTERRUPTED
from smp_motor_ident.cli.processes import ProcessError, Processes


@dataclass(frozen=True)
class Excitation:
    """One signal that all wheels are excited with."""

    signal: str  # as the node ``excite`` names it
    duration: float  # [s]
    amplitude: float  # [V]
    band: tuple[float, float] | None = None  # of Fourier [Hz]


@dataclass(frozen=True)
class Robot:
    """A robot with running nodes, the folder of its results, and its limits."""

    processes: Processes
    client: Any
    wheels: tuple[str, ...]
    folder: Path
    ros_arguments: tuple[str, ...] = ()
    bounds: Mapping[str, object] = field(default_factory=dict)  # parameters of ``excite``

    def uncontrolled(self) -> list[str]:
        """Return the wheels that no ``wheel_pid`` controls."""
        return [wheel for wheel in self.wheels if not self.client.runs_controller(wheel)]

    def start_controllers(self, wheels: Sequence[str]) -> None:
        """Start a ``wheel_pid`` for each wheel, which stays inactive."""
        space = str(self.client.node.get_namespace()).rstrip("/")
        for wheel in wheels:
            place = ["--ros-args", "-r", f"__ns:={space}/{wheel}", "-p", "autostart:=false"]
            given = [*place, *self.ros_arguments]
            self.processes.start(f"{wheel}.wheel_pid", "wheel_pid", *given, priority=1)
        nodes = [get_controller_name(wheel) for wheel in wheels]
        self.client.wait_for_nodes(nodes, TIMEOUT_S)
        self.client.change_states(nodes, "configure")

    def switch(self, transition: str) -> None:
        """Apply a lifecycle transition to every wheel's controller."""
        self.client.change_states([get_controller_name(wheel) for wheel in self.wheels], transition)


TIMEOUT_S = 60.0  # longest time in which a process starts or ends on a busy machine [s]
TOPICS = "/(.*/)?(motor_.*|pid_state|wheel_setpoints|cmd_vel|odom|joint_states|diagnostics)"
"""Topics of a robot that ``record`` keeps."""


def record(robot: Robot, name: str, *shown: str) -> Path:
    """Start to record; return once all topics of the wheels are subscribed."""
    bag = robot.folder / name
    arguments = ("--output", str(bag), "--regex", TOPICS, *robot.ros_arguments)
    robot.processes.start("record", "record", *arguments)
    topics = [f"{wheel}/{topic}" for wheel in robot.wheels for topic in ("motor_state", *shown)]
    robot.client.wait_for_listener("record", topics, timeout=TIMEOUT_S)
    return bag


def excite(robot: Robot, one: Excitation, wait: Callable[[], None] = lambda: None) -> None:
    """Excite all wheels by a signal; ``wait`` is called meanwhile."""
    parameters: dict[str, object] = {
        "signal": one.signal, "wheels": f"[{', '.join(robot.wheels)}]",
        "amplitude": float(one.amplitude), "duration": float(one.duration), **robot.bounds,
    }  # fmt: skip
    if one.band:
        parameters["lowest"], parameters["highest"] = one.band
    arguments = [a for n, v in parameters.items() for a in ("-p", f"{n}:={v}")]
    robot.processes.start("excite", "excite", *robot.ros_arguments, "--ros-args", *arguments)
    wait()
    robot.processes.wait("excite", one.duration + TIMEOUT_S)


def run(tool: ModuleType, *arguments: str) -> None:
    """Run a command-line tool in this process; raise ProcessError unless it succeeds."""
    code, name = tool.main(arguments), tool.__name__.rpartition(".")[2]
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    if code != 0:
        raise ProcessError(f"{name} ended with exit code {code}; its messages are above")
