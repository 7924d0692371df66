# SPDX-License-Identifier: Apache-2.0
"""WPILib: SimpleMotorFeedforward kS, kV, kA and kP of a PIDController, volts, every 20 ms.

References
----------
docs.wpilib.org, Introduction to DC Motor Feedforward: ``V = kS sgn(v) + kV v + kA a``; PID Control
in WPILib: ``kP`` in volts per unit of the error, every 20 ms; An Introduction to PID, Tuning a
Flywheel Velocity Controller: feed-forward and kP, no integral.  wpimath,
SimpleMotorFeedforward.hpp: of a constant set-point ``Calculate`` is ``kS sgn(v) + kV v``.
"""

import math
from collections.abc import Mapping

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.exports.target import Format, Gains, plant_of, rounded
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.known_loop import KnownLoop, Setting, Step
from smp_motor_ident.tune.margins import batch_margins, grid_for

PHASE, GAIN, SENSITIVITY, PEAK = 60.0, 2.0, 1.4, 1.01
"""Margins [deg], [-], [-], and the largest peak from set-point to speed, with feed-forward [-]."""


def _proportional(design: Design) -> float:
    """Return the largest proportional gain that keeps the margins without an integral."""
    plant = plant_of(design)
    omega = grid_for(plant)
    gains = np.geomspace(1e-3, 1e3, 1201) / design.motor["dc_gain"]
    loop = gains[:, None] * plant.response(omega)
    m = batch_margins(loop, omega)
    forward = plant.response(omega, true_speed=True) / design.motor["dc_gain"]
    tracked = np.abs((forward + loop) / (1 + loop)).max(axis=1)
    good = tracked <= PEAK
    good &= (m.phase >= PHASE) & (m.gain >= GAIN) & (m.sensitivity <= SENSITIVITY)
    if not good[0]:
        raise DesignError("no proportional gain keeps the margins; shorten the delay")
    return float(gains[int(np.argmin(good)) - 1 if not good.all() else -1])


def _convert(design: Design) -> Gains:
    ratio, gains = design.loop.gear_ratio, design.gains
    numbers = {
        "kS": rounded(gains.feedforward_static),
        "kV": rounded(gains.feedforward_velocity),
        "kA": rounded(gains.feedforward_acceleration),
        "kP": rounded(_proportional(design) * ratio),
    }
    feedback = Feedback(numbers["kP"] / ratio, 0.0)
    return Gains(numbers, feedback, static=numbers["kS"], velocity=numbers["kV"] / ratio)


def _start(setting: Setting) -> Step:
    n = setting.numbers

    def step(setpoint: float, speed: float) -> float:
        static = math.copysign(n["kS"], setpoint) if setpoint else 0.0
        volts = static + n["kV"] * setpoint + n["kP"] * (setpoint - speed)
        return min(max(volts, -setting.supply), setting.supply)

    return step


def _render(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    lines = ["# volts, rad/s of the wheel; times 2 pi per rotation"]
    for wheel, one in gains.items():
        lines.append(f"{wheel}: " + ", ".join(f"{n} = {v:g}" for n, v in one.numbers.items()))
    return "\n".join(lines) + "\n"


FORMAT = Format(
    "wpilib",
    "WPILib feed-forward and kP (volts of wheel rad/s)",
    "docs.wpilib.org, DC motor feedforward and PID control",
    50.0,
    _convert,
    _render,
    ("an integral: a load is held by kP alone", "anti-windup"),
    counts=False,
    known=KnownLoop(
        {"kS": 0.0, "kV": math.nan, "kP": math.nan}, _start, lambda numbers: 0.02, remembers=False
    ),
)
