# SPDX-License-Identifier: Apache-2.0
"""tune --apply: set new gains in running wheel nodes, on trial."""

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smp_motor_control import get_controller_name
from smp_motor_control.parameter_file import read_parameters
from smp_motor_ident.cli.processes import connect
from smp_motor_ident.errors import ParameterError


def apply(wanted: Mapping[str, Mapping[str, Any]], arguments: argparse.Namespace) -> int:
    """Set the gains of running wheels, watch them, and restore the old ones on misbehaviour."""
    limits = [values.get("u_clamp_max", math.inf) for values in wanted.values()]
    supply = max((limit for limit in limits if math.isfinite(limit)), default=12.0)
    with connect("tune", arguments.ros_arguments) as robot:
        from smp_motor_control.nodes.gain_trial import try_gains

        found = robot.get_parameters(
            {get_controller_name(w): list(new) for w, new in wanted.items()}
        )
        new = _print_changes({wheel: found[get_controller_name(wheel)] for wheel in wanted}, wanted)
        if not any(new.values()):
            print("the running gains are these already: nothing to set")
            return 0
        outcome = try_gains(
            robot, new, arguments.watch, supply, lambda text: print(text, flush=True)
        )
    if not outcome.reason:
        print(f"kept: no loop misbehaved within {arguments.watch:g} s")
        return 0
    print(f"restored the old gains after {outcome.after:.2f} s: {outcome.reason}")
    for wheel in outcome.missing:
        print(f"{wheel} does not answer: it may still use the new gains")
    return 1


def from_file(path: Path) -> dict[str, dict[str, Any]]:
    """Read the parameters of wheel nodes from a ROS parameter file."""
    found = {}
    for node, values in read_parameters(path).items():
        *_, wheel, name = ("", "", *node.split("/"))
        if name == "wheel_pid" and wheel:
            found[wheel] = values
    if not found:
        raise ParameterError(f"{path}: holds no /<wheel>/wheel_pid; give a file that tune wrote")
    return found


def _print_changes(
    old: Mapping[str, Mapping[str, Any]], wanted: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Print and return the changes."""
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
