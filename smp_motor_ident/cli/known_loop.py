"""``identify --controller``: recordings that hold set-points in the place of voltages."""

import argparse
import math
import re
from collections.abc import Callable
from dataclasses import replace

from smp_motor_ident import bag
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.record import Record

_SETPOINT = re.compile(r"(^|\s|\.)setpoint=")

Reconstruct = Callable[[Record], Record]


def signal_map(arguments: argparse.Namespace) -> bag.SignalMap:
    """Return the mapping, the set-point standing where a voltage does."""
    items: list[str] = arguments.map
    if arguments.mapping or not any(_SETPOINT.search(item) for item in items):
        raise ParameterError(
            "--controller needs --map setpoint=... velocity=...: what the loop was given, in its "
            "own unit, and what it measured"
        )
    if any(re.search(r"(^|\s|\.)voltage=", item) for item in items):
        raise ParameterError("--controller goes without voltage=: it computes the voltage")
    mapping = bag.parse([_SETPOINT.sub(r"\1voltage=", item) for item in items], arguments.msg)
    motors = {}
    for wheel, plan in mapping.motors.items():
        signals = dict(plan.signals)
        if "velocity" not in signals:
            raise ParameterError(f"--controller: {wheel}: map the velocity that the loop measured")
        if signals["voltage"].topic != signals["velocity"].topic:
            raise ParameterError(
                f"--controller: {wheel}: set-point and velocity must be of one message or row; for "
                "which step of the loop another topic's set-point came in is not known"
            )
        signals["voltage"] = replace(signals["voltage"], unit="V")
        motors[wheel] = replace(plan, signals=signals, held="after")
    return replace(mapping, motors=motors)


def reconstruction(arguments: argparse.Namespace) -> Reconstruct:
    """Return what replaces set-points by the voltages of the loop that ran."""
    from smp_motor_ident.tune.exports import FORMATS
    from smp_motor_ident.tune.known_loop import reconstruct

    name, *items = arguments.controller
    if name not in FORMATS:
        raise ParameterError(f"--controller {name}: must be one of {', '.join(FORMATS)}")
    loop = FORMATS[name].known
    if loop is None:
        raise ParameterError(f"--controller {name}: its arithmetic is not published; log the duty")
    numbers = dict(loop.defaults)
    for item in items:
        key, _, text = item.partition("=")
        if key not in numbers:
            raise ParameterError(f"--controller {item}: {name} takes {', '.join(numbers)}")
        try:
            numbers[key] = float(text)
        except ValueError:
            raise ParameterError(f"--controller {item}: {text!r} is not a number") from None
    missing = [key for key, value in numbers.items() if math.isnan(value)]
    if missing:
        raise ParameterError(f"--controller {name}: give {', '.join(f'{k}=...' for k in missing)}")
    return lambda record: reconstruct(record, loop, numbers)
