# SPDX-License-Identifier: Apache-2.0
"""Arduino PID_v1: PWM of wheel rad/s, proportional on error.

References
----------
github.com/br3ttb/Arduino-PID-Library 1.2.1, PID_v1.cpp, ``Compute``, ``SetTunings``: the sum of
``Ki T e``, with the present error, and the output are both kept within the limits; ``Kp`` on the
error (``P_ON_E``), ``Kd`` on the measurement; ``T`` is ``SampleTime``, whole milliseconds.
"""

import math
from collections.abc import Mapping

from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.exports.target import (
    Format,
    Gains,
    present_error,
    rounded,
    whole_milliseconds,
)
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.known_loop import KnownLoop, Setting, Step

LIMIT = 255


def _convert(design: Design) -> Gains:
    loop, T = design.loop, design.loop.sample_time
    scale = LIMIT / loop.supply_voltage * loop.gear_ratio
    wanted = present_error(design.feedback, T)
    p, i = rounded(max(wanted.p, 0.0) * scale), rounded(wanted.i * scale)
    feedback = Feedback((p + i * T) / scale, i / scale)
    numbers = {"Kp": p, "Ki": i, "Kd": 0.0, "SampleTime": whole_milliseconds(loop)}
    return Gains(numbers, feedback)


def _start(setting: Setting) -> Step:
    n, T = setting.numbers, setting.sample_time
    total = before = 0.0

    def step(setpoint: float, speed: float) -> float:
        nonlocal total, before
        error, slope, before = setpoint - speed, speed - before, speed
        total = min(max(total + n["Ki"] * T * error, -LIMIT), LIMIT)
        pwm = n["Kp"] * error + total - n["Kd"] / T * slope
        return int(min(max(pwm, -LIMIT), LIMIT)) / LIMIT * setting.supply

    return step


def _render(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    lines = []
    for wheel, one in gains.items():
        n, wheel = one.numbers, wheel.replace("/", "_")
        lines += [
            f"// {wheel}: input and set-point in rad/s of the wheel, output in PWM",
            f"PID {wheel}_pid(&{wheel}_speed, &{wheel}_pwm, &{wheel}_target, "
            f"{n['Kp']!r}, {n['Ki']!r}, {n['Kd']!r}, P_ON_E, DIRECT);",
            f"// in setup(): {wheel}_pid.SetOutputLimits(-{LIMIT}, {LIMIT}); "
            f"{wheel}_pid.SetSampleTime({n['SampleTime']}); {wheel}_pid.SetMode(AUTOMATIC);",
        ]
    return "\n".join(lines) + "\n"


FORMAT = Format(
    "arduino_pid",
    "Arduino PID_v1 (PWM of wheel rad/s)",
    "github.com/br3ttb/Arduino-PID-Library",
    100.0,
    _convert,
    _render,
    ("feed-forward", "the planned reference", "anti-windup beyond limits of the sum"),
    known=KnownLoop(
        {"Kp": math.nan, "Ki": math.nan, "Kd": 0.0, "SampleTime": math.nan},
        _start,
        lambda numbers: 1e-3 * numbers["SampleTime"],
    ),
)
