"""RoboClaw: velocity PID with QPPS, 16.16 fixed point.

References
----------
Basicmicro, RoboClaw Series User Manual, commands 28, 29 and 55: QPPS is the speed in counts per
second at full power; P, I and D are sent as 65536 times their value.

The firmware's arithmetic is not published.  Taken is ``duty = (P e + I integral(e)) / QPPS`` with
the error in counts per second: check with IonMotion's velocity plot before trusting the margins.
"""

from __future__ import annotations

from collections.abc import Mapping

from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.exports.target import Format, Gains, present_error, ticks
from smp_motor_ident.tune.feedback import Feedback

UNIT = 65536


def _convert(design: Design) -> Gains:
    loop, T = design.loop, design.loop.sample_time
    if not loop.count_angle:
        raise DesignError("RoboClaw counts quadrature pulses; give --counts-per-revolution")
    static = design.motor["static_voltage"]
    top = design.motor["dc_gain"] * (loop.supply_voltage - static)
    qpps = round(top * ticks(loop))
    # Share of QPPS per count per second, from volts per rad/s of the motor.
    scale = qpps / loop.supply_voltage / ticks(loop)
    wanted = present_error(design.feedback, T)
    p, i = round(max(wanted.p, 0.0) * scale * UNIT), round(wanted.i * scale * UNIT)
    feedback = Feedback((p + i * T) / UNIT / scale, i / UNIT / scale)
    return Gains({"P": p, "I": i, "D": 0, "QPPS": qpps}, feedback, tracking=max(p / max(i, 1), T))


def _render(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    lines = ["# wheel: P, I, D as sent by commands 28 and 29 (65536 is 1.0), and QPPS"]
    for wheel, one in gains.items():
        n = one.numbers
        lines.append(
            f"{wheel}: P {n['P']} ({n['P'] / UNIT:.5g}), I {n['I']} ({n['I'] / UNIT:.5g}), "
            f"D {n['D']}, QPPS {n['QPPS']}"
        )
    return "\n".join(lines) + "\n"


FORMAT = Format(
    "roboclaw",
    "RoboClaw velocity PID (65536ths, QPPS)",
    "Basicmicro, RoboClaw Series User Manual, commands 28 and 29",
    300.0,
    _convert,
    _render,
    (
        "feed-forward",
        "the planned reference: use an acceleration with commands 38 to 40",
        "arithmetic and rate of the firmware, which are not published",
    ),
)
