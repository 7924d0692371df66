# SPDX-License-Identifier: Apache-2.0
"""Designs for the page of ``lab``, in a process of their own that keeps motors and designs."""

import os
from pathlib import Path
from typing import Any

from smp_motor_control.parameter_file import flatten
from smp_motor_ident.cli import tune, tuning
from smp_motor_ident.cli.workers import end_with_parent
from smp_motor_ident.report import tuning_page
from smp_motor_ident.report.tuning_page import Choice
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune import Design
from smp_motor_ident.tune.curves import curves
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.reference import STEP_SHARE
from smp_motor_ident.tune.writing import parameters

NICENESS = 5  # of the design process


def begin() -> None:
    """Initialise the design process: it ends with its parent and has a low priority."""
    end_with_parent()
    os.nice(NICENESS)


_estimates: dict[str, Estimate] = {}
_own: dict[str, Design] = {}  # the designs of ``tune``


def design_all(identified: Path, output: Path, accept_unreliable: bool) -> dict[str, Any]:
    """Do what ``tune IDENTIFIED --output OUTPUT`` does; return every wheel's design and reason."""
    given = [str(identified), "--output", str(output)]
    arguments = tune.parser().parse_args(
        [*given, *(["--accept-unreliable"] if accept_unreliable else [])]
    )
    estimates = tuning.read_estimates(identified)
    wheels, reasons = tuning.design_together(estimates, arguments)
    files = [output, output.with_suffix(".json"), output.with_suffix(".svg")]
    tuning.write(files, wheels, estimates, arguments, reasons)
    _estimates.update(estimates)
    _own.update(wheels.designs)
    margin = tuning_page.DEFAULT_PHASE_MARGIN
    choices = {
        wheel: Choice(one.margins.crossover, margin, one, curves(estimates[wheel], one))
        for wheel, one in wheels.designs.items()
    }
    shown = {wheel: tuning_page.Tuning(wheel, [choice], 0) for wheel, choice in choices.items()}
    return {
        "reason": wheels.reason,
        "charts": tuning_page.page_charts(shown),
        "designs": {wheel: _describe(wheel, choice) for wheel, choice in choices.items()},
    }


def choose(wheel: str, share: float, phase_margin: float) -> dict[str, Any]:
    """Design one wheel for a share of its largest bandwidth and a phase margin [deg]."""
    estimate, own = _estimates[wheel], _own[wheel]
    bandwidth = share * own.margins.crossover
    return _describe(wheel, tuning_page.choose(estimate, own.loop, bandwidth, phase_margin, own))


def judge(wheel: str, p: float, i: float, d: float) -> dict[str, Any]:
    """Evaluate gains that were typed by hand [V s/rad and so on, wheel]."""
    estimate, own = _estimates[wheel], _own[wheel]
    feedback = Feedback(p, i, d, own.feedback.filter_time).scaled(1 / own.loop.gear_ratio)
    return _describe(wheel, tuning_page.judge(estimate, own, feedback))


def _describe(wheel: str, choice: Choice) -> dict[str, Any]:
    """Return a design for the page and the robot."""
    found = choice.design
    made = {**tuning_page.describe(choice), "wheel": wheel}
    if found is None or choice.curves is None:
        return made
    return {
        **made,
        "crossover": found.margins.crossover,
        "phase_margin": found.margins.phase,
        "gains": [found.gains.p, found.gains.i, found.gains.d],
        "change": STEP_SHARE * found.wheel_reference.max_velocity,
        "settling": found.settling.value,
        "parameters": flatten(parameters(found)),
    }
