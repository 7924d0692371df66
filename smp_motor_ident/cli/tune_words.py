"""What tune tells: designs as rows, delays and provenance as lines."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from smp_motor_ident.bag.transport import TransportDelay
from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune import Design, Loop, WheelSet


def tell_delays(
    loops: Mapping[str, Loop],
    measured: Mapping[str, TransportDelay],
    arguments: argparse.Namespace,
) -> list[str]:
    """Return where the delays come from, in a line for each wheel, if a bag was to tell them."""
    lines = []
    for wheel, loop in loops.items() if arguments.bag is not None else ():
        if wheel not in measured:
            lines.append(f"{wheel}: {arguments.bag} tells no delay: taken as one sample")
            continue
        one = measured[wheel]
        lines.append(
            f"{wheel}: delay usually {1e3 * loop.expected_delay:.3g} ms, at most "
            f"{1e3 * loop.loop_delay:.3g} ms, from {one.answers} commands of {arguments.bag} that "
            f"arrived after {1e3 * one.usual:.3g} ms, 95 % within {1e3 * one.longest:.3g} ms"
            + (", and wait for the driver's next sample" if one.latched else "")
        )
    return lines


HEAD = (
    f"  {'method':16s} {'p':>7} {'i':>7} {'d':>7} {'PM':>4} {'GM':>5} {'Ms':>5} {'settle':>7} "
    f"{'over':>5} {'load':>6} {'volts':>6} {'noise':>6}"
)
"""Of a table of designs."""


def row(result: Design | DesignError) -> str:
    """Return a design as a row under :data:`HEAD`."""
    if isinstance(result, DesignError):
        return str(result)
    g, m, f = result.gains, result.margins, result.performance
    return (
        f"{g.p:7.3f} {g.i:7.2f} {g.d:7.4f} {m.phase:4.0f} {m.gain:5.2f} {m.sensitivity:5.2f} "
        f"{1e3 * f.settling:5.0f}ms {f.overshoot:4.1f}% {f.load_integral:6.3f} "
        f"{f.peak_voltage:5.2f}V {1e3 * f.control_noise:4.0f}mV"
    )


def show(wheels: WheelSet) -> None:
    """Print the designs of all wheels, and why they are as they are."""
    print(f"  {'wheel':16s}{HEAD[18:]}")
    for wheel, design in wheels.designs.items():
        print(f"  {wheel:16s} {row(design)}")
    print(wheels.reason)
    for wheel, design in wheels.designs.items():
        print(f"{wheel}: {design.reason}")
        for warning in design.warnings:
            print(f"{wheel}: warning: {warning}")


def provenance(
    wheels: WheelSet, arguments: argparse.Namespace, estimates: Mapping[str, Estimate], now: str
) -> list[str]:
    """Return where gains come from, as lines for the head of their file."""
    lines = [
        f"Gains of the wheel nodes, designed {now} by tune from {arguments.source}.",
        "Units: wheel rad/s, volts, seconds; model.* at the motor shaft.",
        wheels.reason,
    ]
    for wheel, design in wheels.designs.items():
        sources = ", ".join(estimates[wheel].sources) or "unknown"
        lines.append(f"{wheel}: {estimates[wheel].model} model from {sources}")
        lines.append(f"  {design.reason}")
        lines.extend(f"  warning: {warning}" for warning in design.warnings)
    return lines
