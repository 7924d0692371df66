"""ros_arduino_bridge: integers, ticks per interval at 30 Hz, one set for both wheels.

References
----------
github.com/hbrobotics/ros_arduino_bridge, ROSArduinoBridge, diff_controller.h:
``output += (Kp e - Kd (input - input_before) + ITerm) / Ko`` in whole numbers, at most 255.

It is a velocity algorithm: what is called ``Kp`` integrates, ``Kd`` is proportional action on the
measurement, ``Ki`` would integrate twice and stays 0.
"""

from __future__ import annotations

from collections.abc import Mapping

from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.exports.target import Format, Gains, ticks
from smp_motor_ident.tune.feedback import Feedback

MAX_PWM, LARGEST = 255, 1000


def _convert(design: Design) -> Gains:
    loop, T = design.loop, design.loop.sample_time
    if not loop.count_angle:
        raise DesignError("ros_arduino_bridge counts ticks; give --counts-per-revolution")
    # PWM per tick in an interval, from volts per rad/s of the motor.
    scale = MAX_PWM / loop.supply_voltage / (ticks(loop) * T)
    # ``Kp`` takes the present error: so much less is left to the proportional action.
    integral = design.feedback.i * T * scale
    proportional = max(design.feedback.p - design.feedback.i * T, 0.0) * scale
    Ko = max(min(int(LARGEST / max(integral, proportional)), LARGEST), 1)
    Kp, Kd = max(round(integral * Ko), 1), round(proportional * Ko)
    kp, kd = Kp / Ko / scale, Kd / Ko / scale
    # On the measurement the present error's share is proportional action, too.
    feedback = Feedback(kd + kp, kp / T)
    weight = kp / (kd + kp)
    rest = Ko / Kp / (ticks(loop) * T)
    return Gains(
        {"Kp": Kp, "Kd": Kd, "Ki": 0, "Ko": Ko}, feedback, weight, tracking=T, resting_error=rest
    )


def _render(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    one, numbers = next(iter(designs.values())), next(iter(gains.values())).numbers
    lines = [f"#define PID_RATE {round(one.loop.rate)}"]
    return "\n".join([*lines, *(f"int {n} = {int(v)};" for n, v in numbers.items())]) + "\n"


FORMAT = Format(
    "ros_arduino_bridge",
    "ros_arduino_bridge (PWM of ticks per interval, integers)",
    "github.com/hbrobotics/ros_arduino_bridge, diff_controller.h",
    30.0,
    _convert,
    _render,
    (
        "feed-forward",
        "the planned reference",
        "errors below Ko/Kp ticks an interval, which whole numbers round to nothing",
    ),
    one_set=True,
)
