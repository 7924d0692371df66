"""One motor, one loop, one method: prepared, solved, and backed off where it has to be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.methods import METHODS
from smp_motor_ident.tune.motors import draw_motors, motors_of
from smp_motor_ident.tune.plant import sample
from smp_motor_ident.tune.problem import Method, Problem, Promise, checked, ripple
from smp_motor_ident.tune.robust import Jury, Robustness, back_off, softer

CLAMPED = 1 / 6
"""Largest ripple [share of the supply, rms] of any gains: three times it is half of the supply, and
a loop whose noise is clamped is none."""


WORK, FEWEST = 5e7, 50
"""Draws times the cube of the loop's states that is spent at most; and least draws."""

COMMON = (
    "max_velocity", "max_acceleration", "transition_time", "together", "samples", "seed",
)  # fmt: skip
"""Targets that every method understands."""


@dataclass(frozen=True)
class Case:
    """One motor, one loop, one method: what is needed to judge and to finish a design.

    Attributes
    ----------
    wheel : str
        Whose motor.
    method : Method
        The method that was asked for.
    problem : Problem
        The nominal motor and the targets.
    promise : Promise
        What the gains must keep.
    jury : Jury
        The motors that the data allow.
    drawn : bool
        Whether these were drawn; else the jury is the nominal motor alone.
    """

    wheel: str
    method: Method
    problem: Problem
    promise: Promise
    jury: Jury
    drawn: bool


def prepare(estimate: Estimate, loop: Loop, method: str, targets: dict[str, Any]) -> Case:
    """Sample the motor and the draws of its distribution; see :func:`design`.

    Parameters
    ----------
    estimate, loop, method
        As for :func:`design`.
    targets : dict
        Its keywords.

    Returns
    -------
    Case

    Raises
    ------
    DesignError
        When method or targets are unknown.
    """
    chosen = _method(method, targets)
    plant = sample(motors_of(estimate), loop)
    problem = Problem(plant, loop, targets)
    promise = _promise(chosen, problem)
    n = int(checked(targets, "samples") or 1000)
    seed = int(checked(targets, "seed", least=-1) or 0)
    # Eigenvalues cost with the cube of the states: fewer motors where a loop has many.
    states = plant.taps.shape[1] + plant.window + 6
    n = max(min(n, int(WORK / states**3)), FEWEST)
    motors = draw_motors(estimate, n, np.random.default_rng(seed))
    draws = plant if motors is None else sample(motors, loop, believed=plant.motors)
    jury = Jury(draws, promise)
    return Case(estimate.wheel, chosen, problem, promise, jury, motors is not None)


def solve(case: Case) -> tuple[Feedback, float, Robustness]:
    """Find the feedback gains, backed off as far as the uncertainty asks for it.

    Parameters
    ----------
    case : Case
        From :func:`prepare`.

    Returns
    -------
    feedback : Feedback
        At the motor shaft.
    factor : float
        By which the rule's gains were backed off; 1 where they were not.
    robustness : Robustness

    Raises
    ------
    DesignError
        When the demand cannot be met.
    """
    ruled = case.method.solve(case.problem)
    quiet, calm = _within_clamp(case.problem, ruled)
    feedback, factor, robustness = back_off(case.jury, quiet)
    factor *= calm
    if factor == 0.0:
        raise DesignError(
            f"{case.wheel}: no gains of this kind keep a phase margin of "
            f"{case.promise.phase:g} deg and Ms {case.promise.sensitivity:g} over the motors that "
            f"the data allow (only {robustness.holds:.0%} do); record more, or ask for smaller "
            "margins"
        )
    return feedback, factor, robustness


def _within_clamp(problem: Problem, feedback: Feedback) -> tuple[Feedback, float]:
    """Soften gains until what quantisation makes at the output leaves room within the clamp."""
    factor, trial = 1.0, feedback
    while ripple(problem, trial) > CLAMPED * problem.loop.supply_voltage and factor > 0.01:
        factor *= 0.95
        trial = softer(feedback, factor)
    return trial, factor


def _method(name: str, targets: dict[str, Any]) -> Method:
    if name not in METHODS:
        raise DesignError(f"method is {name!r}; it must be one of {', '.join(METHODS)}")
    known = (*METHODS[name].targets, *COMMON)
    unknown = [key for key in targets if key not in known]
    if unknown:
        raise DesignError(
            f"the method {name!r} knows no target {unknown[0]!r}; it knows {', '.join(known)}"
        )
    return METHODS[name]


def _promise(method: Method, problem: Problem) -> Promise:
    """Return what the method promises, as far as the caller's targets leave it."""
    promise = method.promise
    return Promise(
        phase=problem.target("phase_margin", promise.phase),
        gain=promise.gain,
        sensitivity=problem.target("maximum_sensitivity", promise.sensitivity, least=1.0),
    )
