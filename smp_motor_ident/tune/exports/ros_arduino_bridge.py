# SPDX-License-Identifier: Apache-2.0
"""ros_arduino_bridge: integers, ticks per interval of 33 ms, one set for both wheels.

References
----------
github.com/hbrobotics/ros_arduino_bridge (a960c8a), ros_arduino_firmware, ROSArduinoBridge:
diff_controller.h, ``doPID``: ``output += (Kp e - Kd (input - input_before) + ITerm) / Ko`` in whole
numbers, at most 255; ROSArduinoBridge.ino: ``PID_INTERVAL = 1000 / PID_RATE`` in whole
milliseconds, 33 of ``PID_RATE`` 30, and set-points in whole ticks per interval. ros_arduino_python,
base_controller.py: the node sends its own ``Kp``, ``Kd``, ``Ki``, ``Ko`` over those of the
firmware.

``Kd (input - input_before)`` is a product of 16 bits on an AVR: ``Kd`` stays so small that a wheel
blocked at full speed does not overflow it. It is a velocity algorithm: its ``Kp``
integrates, ``Kd`` is proportional action on the measurement, ``Ki`` would integrate twice and stays
0.
"""

import math
from collections.abc import Mapping

from smp_motor_ident.errors import DesignError, SignalError
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.exports.target import (
    Format,
    Gains,
    ticks,
    top_speed,
    whole_milliseconds,
)
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.known_loop import KnownLoop, Setting, Step

MAX_PWM, MAX_GAIN, INT16 = 255, 1000, 32767


def _convert(design: Design) -> Gains:
    loop, T = design.loop, design.loop.sample_time
    if not loop.count_angle:
        raise DesignError("ros_arduino_bridge counts ticks; give --counts-per-revolution")
    # PWM per tick in an interval, from volts per rad/s of the motor.
    scale = MAX_PWM / loop.supply_voltage / (ticks(loop) * T)
    # ``Kp`` takes the present error: so much less is left to the proportional action.
    integral = design.feedback.i * T * scale
    proportional = max(design.feedback.p - design.feedback.i * T, 0.0) * scale
    largest = min(MAX_GAIN, INT16 / (top_speed(design) * ticks(loop) * T))
    Ko = _find_divisor(integral, proportional, largest)
    Kp, Kd = max(round(integral * Ko), 1), round(proportional * Ko)
    kp, kd = Kp / Ko / scale, Kd / Ko / scale
    # On the measurement the present error's share is proportional action, too.
    feedback = Feedback(kd + kp, kp / T)
    weight = kp / (kd + kp)
    rest = Ko / Kp / (ticks(loop) * T)
    return Gains(
        {"Kp": Kp, "Kd": Kd, "Ki": 0, "Ko": Ko}, feedback, weight, tracking=T, resting_error=rest
    )


def _start(setting: Setting) -> Step:
    if math.isnan(setting.ticks):
        raise SignalError("ros_arduino_bridge counts ticks; give counts_per_revolution")
    n, per_interval = setting.numbers, setting.ticks * setting.sample_time
    output = before = term = 0

    def step(setpoint: float, speed: float) -> float:
        nonlocal output, before, term
        if setpoint == 0.0:
            output = before = term = 0
            return 0.0
        turned = round(speed * per_interval)
        error = round(setpoint) - turned
        output += int((n["Kp"] * error - n["Kd"] * (turned - before) + term) / n["Ko"])
        if abs(output) < MAX_PWM:
            term += int(n["Ki"] * error)
        output, before = min(max(output, -MAX_PWM), MAX_PWM), turned
        return output / MAX_PWM * setting.supply

    return step


def _find_divisor(integral: float, proportional: float, largest: float) -> int:
    """Return the ``Ko`` with the smallest rounding error of two integer gains."""
    most = max(min(int(largest / max(integral, proportional)), MAX_GAIN), 1)

    def error(Ko: int) -> float:
        one = abs(max(round(integral * Ko), 1) / (integral * Ko) - 1)
        other = abs(round(proportional * Ko) / (proportional * Ko) - 1) if proportional else 0.0
        return max(one, other)

    return min(range(1, most + 1), key=error)


def _pid_rate(milliseconds: int) -> int:
    """Return the ``PID_RATE`` that the firmware divides into an interval."""
    rate = 1000 // milliseconds
    if 1000 // rate != milliseconds:
        nearest = 1000 / (1000 // rate)
        raise DesignError(
            f"no PID_RATE gives an interval of {milliseconds} ms; --rate {nearest:.5g}"
        )
    return rate


def _render(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    one, numbers = next(iter(designs.values())), next(iter(gains.values())).numbers
    milliseconds = whole_milliseconds(one.loop)
    lines = [f"#define PID_RATE {_pid_rate(milliseconds)}  // {milliseconds} ms"]
    lines += [f"int {n} = {int(v)};" for n, v in numbers.items()]
    lines.append("// The ROS node sends its own over these; in arduino_params.yaml:")
    return "\n".join([*lines, *(f"// {n}: {int(v)}" for n, v in numbers.items())]) + "\n"


FORMAT = Format(
    "ros_arduino_bridge",
    "ros_arduino_bridge (PWM of ticks per interval, integers)",
    "github.com/hbrobotics/ros_arduino_bridge, diff_controller.h",
    1000 / 33,
    _convert,
    _render,
    (
        "feed-forward",
        "the planned reference",
        "errors below Ko/Kp ticks an interval, which whole numbers round to nothing",
    ),
    one_set=True,
    known=KnownLoop(
        {"Kp": math.nan, "Kd": math.nan, "Ki": 0.0, "Ko": math.nan},
        _start,
        lambda numbers: 0.033,
    ),
)
