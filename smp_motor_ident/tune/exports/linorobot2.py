# SPDX-License-Identifier: Apache-2.0
"""linorobot2: PWM of wheel RPM, every 20 ms, one set for all wheels.

References
----------
github.com/linorobot/linorobot2_hardware (8a95745): config/lino_base_config.h (``K_P``, ``K_I``,
``K_D``, ``PWM_BITS``), firmware/lib/pid/pid.cpp, ``compute``, firmware/lib/encoder/encoder.h,
``getRPM``, firmware/src/firmware.ino (a timer of 20 ms).
``pwm = K_P e + K_I sum(e) + K_D (e - e_before)``, the sum with the present error and without a
limit, emptied where set-point and error are both 0; the output is kept within ``PWM_MIN`` and
``PWM_MAX`` (``2^PWM_BITS - 1``) and cut to a whole number.
"""

import math
from collections.abc import Mapping

from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.exports.target import Format, Gains, present_error, rounded
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.known_loop import KnownLoop, Setting, Step

PWM_BITS = 10


def _convert(design: Design) -> Gains:
    loop, T = design.loop, design.loop.sample_time
    # PWM per RPM of the wheel, from volts per rad/s of the motor.
    scale = (2**PWM_BITS - 1) / loop.supply_voltage * loop.gear_ratio * 2 * math.pi / 60
    wanted = present_error(design.feedback, T)
    p, i = rounded(max(wanted.p, 0.0) * scale), rounded(wanted.i * T * scale)
    feedback = Feedback((p + i) / scale, i / T / scale)
    return Gains({"K_P": p, "K_I": i, "K_D": 0.0}, feedback)


def _start(setting: Setting) -> Step:
    n, full = setting.numbers, 2 ** setting.numbers["PWM_BITS"] - 1
    total = before = 0.0

    def step(setpoint: float, speed: float) -> float:
        nonlocal total, before
        error = setpoint - speed * 60 / (2 * math.pi)
        total, slope, before = total + error, error - before, error
        if setpoint == 0.0 and error == 0.0:
            total = slope = 0.0
        pwm = n["K_P"] * error + n["K_I"] * total + n["K_D"] * slope
        return int(min(max(pwm, -full), full)) / full * setting.supply

    return step


def _render(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    numbers = next(iter(gains.values())).numbers
    lines = [f"#define PWM_BITS {PWM_BITS}"]
    return "\n".join([*lines, *(f"#define {n} {v!r}" for n, v in numbers.items())]) + "\n"


FORMAT = Format(
    "linorobot2",
    "linorobot2 firmware (PWM of wheel RPM)",
    "github.com/linorobot/linorobot2_hardware",
    50.0,
    _convert,
    _render,
    ("feed-forward", "anti-windup", "the planned reference"),
    one_set=True,
    known=KnownLoop(
        {"K_P": math.nan, "K_I": math.nan, "K_D": 0.0, "PWM_BITS": PWM_BITS},
        _start,
        lambda numbers: 0.02,
    ),
)
