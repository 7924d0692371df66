# SPDX-License-Identifier: Apache-2.0
"""Export gains to other loops, in their own units and arithmetic."""

import math
from collections.abc import Mapping
from typing import Any

from smp_motor_control.errors import printable
from smp_motor_ident.limits import SETTLING_BAND
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.exports.formats import FORMATS
from smp_motor_ident.tune.exports.target import TARGETS, Check, Format, Gains, check
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.wheels import Sets, design_wheels


def export(
    name: str, estimates: Mapping[str, Estimate], loops: Mapping[str, Loop], **targets: Any
) -> tuple[str, dict[str, Check]]:
    """Design for a target's loop and return its parameters as text, with their effect."""
    target = FORMATS[name]
    sets: Sets = "one" if target.one_set else "each"
    asked = {**TARGETS, **targets}
    wheels = design_wheels(estimates, loops, "margin", sets, together=False, **asked)
    gains = {wheel: target.convert(one) for wheel, one in wheels.designs.items()}
    checks = {wheel: check(one, gains[wheel]) for wheel, one in wheels.designs.items()}
    mark = "//" if name in ("linorobot2", "ros_arduino_bridge", "arduino_pid") else "#"
    head = [f"{target.title}, from {target.source}", f"not expressed: {'; '.join(target.missing)}"]
    for wheel, one in checks.items():
        m, step = one.margins, one.step
        head.append(
            f"{wheel} at {wheels.designs[wheel].loop.rate:.4g} Hz: phase margin {m.phase:.0f} deg, "
            f"gain margin {m.gain:.2f}, Ms {m.sensitivity:.2f}; an abrupt change by half of the "
            f"largest speed {_describe_settling(one)}, overshoot {step.overshoot:.2g} %"
        )
        head.extend(f"  {words}" for words in wheels.designs[wheel].warnings)
    # A backslash at the end would extend the comment to the next line
    text = "".join(f"{mark} {printable(line).replace(chr(92), '/')}\n" for line in head)
    return text + target.render(wheels.designs, gains), checks


def _describe_settling(one: Check) -> str:
    if one.resting_error > SETTLING_BAND:
        return f"rests within {100 * one.resting_error:.1f} % of it, as whole numbers allow"
    if math.isnan(one.step.settling):
        return "does not settle within 2 %"
    return f"settles in {one.step.settling:.3g} s"


__all__ = ["FORMATS", "TARGETS", "Check", "Format", "Gains", "check", "export"]
