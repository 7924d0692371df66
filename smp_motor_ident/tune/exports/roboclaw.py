# SPDX-License-Identifier: Apache-2.0
"""RoboClaw: velocity PID with QPPS, 16.16 fixed point.

References
----------
Basicmicro, RoboClaw Series User Manual: commands 28, 29 and 55 (QPPS is the speed in counts per
second at full power; P, I and D are sent as 65536 times their value), command 30 (speeds are
counted over 300ths of a second). forums.ionmc.com, topic 774, answer of Basicmicro Support: the
set-point is fed forward by QPPS.

The firmware's arithmetic is not published. Taken is ``duty = (v + P e + I integral(e)) / QPPS``
with set-point ``v`` and error in counts per second: check with Motion Studio's velocity plot before
trusting the margins. Since the set-point is fed forward, P and I are lowered until an abrupt change
does not overshoot by more than 2 %.
"""

from collections.abc import Mapping

from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.exports.target import (
    Format,
    Gains,
    check,
    present_error,
    ticks,
    top_speed,
)
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.limits import SETTLING_BAND

FIXED_POINT_ONE = 65536

GAIN_SHARES = tuple(2.0 ** (-n / 2) for n in range(13))
"""Of the designed gains, tried from the largest on: P takes one, I its square."""


def _convert(design: Design) -> Gains:
    loop, T = design.loop, design.loop.sample_time
    if not loop.count_angle:
        raise DesignError("RoboClaw counts quadrature pulses; give --counts-per-revolution")
    qpps = round(top_speed(design) * ticks(loop))
    # Share of QPPS per count per second, from volts per rad/s of the motor.
    scale = qpps / loop.supply_voltage / ticks(loop)
    wanted = present_error(design.feedback, T)
    forward = loop.supply_voltage * ticks(loop) / qpps

    def gains(share: float) -> Gains:
        p = round(share * max(wanted.p, 0.0) * scale * FIXED_POINT_ONE)
        i = round(share**2 * wanted.i * scale * FIXED_POINT_ONE)
        feedback = Feedback((p + i * T) / FIXED_POINT_ONE / scale, i / FIXED_POINT_ONE / scale)
        numbers = {"P": p, "I": i, "D": 0, "QPPS": qpps}
        return Gains(numbers, feedback, velocity=forward, tracking=max(p / max(i, 1), T))

    tried = map(gains, GAIN_SHARES)
    most = 100 * SETTLING_BAND.value
    return next((one for one in tried if check(design, one).step.overshoot <= most), gains(0.0))


def _render(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    lines = ["# wheel: P, I, D as sent by commands 28 and 29 (65536 is 1.0), and QPPS"]
    for wheel, one in gains.items():
        n = one.numbers
        lines.append(
            f"{wheel}: P {n['P']} ({n['P'] / FIXED_POINT_ONE:.5g}), "
            f"I {n['I']} ({n['I'] / FIXED_POINT_ONE:.5g}), D {n['D']}, QPPS {n['QPPS']}"
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
        "feed-forward of dry friction",
        "the planned reference: use an acceleration with commands 38 to 40",
        "arithmetic and rate of the firmware, which are not published",
    ),
)
