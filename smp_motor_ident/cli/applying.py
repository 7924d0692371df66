"""tune --apply: new gains into running wheel nodes, on trial.

What needs ROS is done by the node ``gain_setter`` in a process of its own; see its requests.
"""

from __future__ import annotations

import json
import math
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smp_motor_control.parameter_file import flat, read_parameters
from smp_motor_ident.cli.processes import ProcessError, Processes
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.tune import Design
from smp_motor_ident.tune.writing import parameters


def apply(wanted: Mapping[str, Mapping[str, Any]], watch: float) -> bool:
    """Set the gains of running wheels, watch them, and take them back if a loop misbehaves."""
    limits = [values.get("u_clamp_max", math.inf) for values in wanted.values()]
    supply = max((limit for limit in limits if math.isfinite(limit)), default=12.0)
    with tempfile.TemporaryDirectory() as logs, Processes(Path(logs)) as processes:
        setter = processes.start("gain_setter", "gain_setter", pipes=True)
        names = {wheel: list(values) for wheel, values in wanted.items()}
        old = _ask(setter, processes, do="read", wheels=names)["values"]
        new = _changes(old, wanted)
        if not any(new.values()):
            print("the running gains are these already: nothing to set")
            return True
        answer = _ask(setter, processes, do="apply", values=new, watch=watch, supply=supply)
    if answer["kept"]:
        print(f"kept: no loop misbehaved within {watch:g} s")
    else:
        print(f"taken back after {answer['after']:.2f} s: {answer['reason']}")
    return bool(answer["kept"])


def from_designs(designs: Mapping[str, Design]) -> dict[str, dict[str, Any]]:
    """Return the parameters of designed wheels by their ROS names."""
    return {wheel: flat(parameters(design)) for wheel, design in designs.items()}


def from_file(path: Path) -> dict[str, dict[str, Any]]:
    """Read the parameters of wheel nodes from a ROS parameter file."""
    nodes = read_parameters(path)
    found = {
        node[1 : -len("/wheel_pid")]: values
        for node, values in nodes.items()
        if node.endswith("/wheel_pid") and node != "/wheel_pid"
    }
    if not found:
        raise ParameterError(f"{path}: holds no /<wheel>/wheel_pid; give a file that tune wrote")
    return found


def _changes(
    old: Mapping[str, Mapping[str, Any]], wanted: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Print what will change, and return it."""
    new: dict[str, dict[str, Any]] = {}
    for wheel, values in wanted.items():
        had = old[wheel]
        new[wheel] = {n: v for n, v in values.items() if n in had and had[n] != v}
        print(f"{wheel}:" + ("" if new[wheel] else " no change"))
        for name, value in new[wheel].items():
            print(f"  {name:34s} {_text(had[name]):>14s} -> {_text(value)}")
        missing = [name for name in values if name not in had]
        if missing:
            print(f"  the node has no {', '.join(missing)}: left out")
    return new


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _ask(setter: subprocess.Popen[bytes], processes: Processes, **request: Any) -> dict[str, Any]:
    assert setter.stdin is not None
    assert setter.stdout is not None
    try:
        setter.stdin.write(json.dumps(request).encode() + b"\n")
        setter.stdin.flush()
        line = setter.stdout.readline()
    except BrokenPipeError:
        line = b""
    if not line:
        raise ProcessError(f"gain_setter ended: {processes.last_words('gain_setter')}")
    answer: dict[str, Any] = json.loads(line)
    if "error" in answer:
        raise ProcessError(str(answer["error"]))
    return answer
