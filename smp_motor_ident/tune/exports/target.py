# SPDX-License-Identifier: Apache-2.0
"""Describe an export: gains for another loop, their effect in it, and its limitations."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.limits import SETTLING_BAND
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.feedback import Feedback, Margins, loop_margins
from smp_motor_ident.tune.known_loop import KnownLoop
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.reference import STEP_SHARE
from smp_motor_ident.tune.simulation import Controller, Inputs, StepFigures, simulate, step_figures

TARGETS = {"structure": "pi", "focus": "tracking"}  # targets of exported designs


@dataclass(frozen=True)
class Gains:
    """Gains in a target's own units, and their equivalents at the motor shaft."""

    numbers: Mapping[str, float]  # as the target takes them
    feedback: Feedback  # the same, as rounded, as the feedback of the running loop
    weight: float = 1.0  # set-point weight of the proportional action [-]
    # Time constant of the anti-windup nearest to that of the target [s]
    tracking: float = math.inf
    resting_error: float = 0.0  # largest error that integer arithmetic ignores [rad/s, motor]


@dataclass(frozen=True)
class Format:
    """Another software's loop."""

    # name, title, source: keyword, words for people, and where its arithmetic is documented
    name: str
    title: str
    source: str
    rate: float  # steps per second, unless the user says otherwise [Hz]
    convert: Callable[[Design], Gains]  # from a design to the target's numbers
    # From the numbers of all wheels to the text that the target takes
    render: Callable[[Mapping[str, Design], Mapping[str, Gains]], str]
    missing: tuple[str, ...]  # parts of a design that it cannot express
    known: KnownLoop  # its arithmetic
    counts: bool = True  # whether it makes its speed from counts, over one of its intervals
    one_set: bool = False  # whether all wheels share their numbers


@dataclass(frozen=True)
class Check:
    """Behaviour of exported gains in the target's loop."""

    margins: Margins  # of that loop
    # Of an abrupt change of set-point from rest by half of the largest speed; no settling time
    # where it may rest beyond 2 %
    step: StepFigures
    resting_error: float  # largest error at rest as a share of that change [-]


MILLISECOND = 1e-3  # tolerance for whole milliseconds, since rates have six digits


def check(design: Design, gains: Gains) -> Check:
    """Compute margins and step response of the loop that the target runs."""
    loop, plant = design.loop, design.plant
    target = STEP_SHARE * design.reference.max_velocity
    steps = int(duration(design, gains) / loop.sample_time)
    time = loop.sample_time * np.arange(steps, dtype=np.float64)
    controller = Controller(
        gains.feedback, weight=gains.weight, limit=loop.supply_voltage, tracking=gains.tracking
    )
    friction = np.array([design.motor["static_voltage"]])
    run = simulate(plant, controller, Inputs(np.full(time.size, target)), friction=friction)
    step = step_figures(time, run.speed[0], run.voltage[0], target)
    if gains.resting_error > SETTLING_BAND * target:
        step = replace(step, settling=math.nan)
    return Check(loop_margins(plant, gains.feedback), step, gains.resting_error / target)


def duration(design: Design, gains: Gains) -> float:
    """Return the simulated length of a change of set-point [s].

    The slow mode of the integral decays with ``(p + a0) / i`` from the error that proportional
    action leaves, and from the integral of the rise; it is followed down to a tenth of the settling
    band.
    """
    fb, a0, rise = gains.feedback, 1 / design.motor["dc_gain"], design.motor["time_constant"]
    slow = (fb.p + a0) / fb.i
    target = STEP_SHARE * design.reference.max_velocity
    needed = a0 + design.motor["static_voltage"] / target
    left = abs(fb.p * (gains.weight - 1) - needed) / (fb.p + a0) + rise / slow
    tail = slow * max(math.log(10 * left / SETTLING_BAND), 0.0)
    return float(0.5 + 12 * rise + tail)


def absorb_present_error(feedback: Feedback, sample_time: float) -> Feedback:
    """Return the gains for an integral that includes the present error.

    ``p e + I + i T e`` is ``(p + i T) e + I``, which contains part of the proportional gain.
    """
    return Feedback(feedback.p - feedback.i * sample_time, feedback.i)


def top_speed(design: Design) -> float:
    """Return the speed at the whole supply, friction taken off [rad/s, motor]."""
    return design.motor["dc_gain"] * (design.loop.supply_voltage - design.motor["static_voltage"])


def whole_milliseconds(loop: Loop) -> int:
    """Return the interval of a target that counts milliseconds."""
    milliseconds = 1e3 * loop.sample_time
    if abs(milliseconds - round(milliseconds)) > MILLISECOND or milliseconds < 1:
        raise DesignError(
            f"the target's interval is a whole number of milliseconds, and {loop.rate:.5g} Hz is "
            f"{milliseconds:.5g}; --rate {1e3 / max(round(milliseconds), 1):.6g}"
        )
    return round(milliseconds)


def ticks(loop: Loop) -> float:
    """Return the counts of a motor radian."""
    return 1 / loop.count_angle if loop.count_angle else math.nan


def rounded(value: float) -> float:
    """Return a number as it is printed."""
    return float(f"{value:.5g}")
