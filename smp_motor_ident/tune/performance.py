"""How a design performs in simulation: the columns of the comparison."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smp_motor_ident.tune.plant import Plant
from smp_motor_ident.tune.problem import Problem
from smp_motor_ident.tune.reference import CHANGE, Reference, planned_change
from smp_motor_ident.tune.response import (
    Controller,
    load_figures,
    simulate,
    step_figures,
)


@dataclass(frozen=True)
class Performance:
    """What the simulated loop does; speeds at the motor shaft.

    Attributes
    ----------
    rise, settling : float
        Of a set-point step through the reference [s]: 10 to 90 %, and until within 2 %.
    overshoot : float
        Of the same [%].
    step_settling, step_overshoot : float
        The same for an abrupt step with the feedback gains alone.
    load_peak : float
        Speed lost per volt of load [rad/s/V].
    load_integral : float
        Integral of the magnitude of the error per volt of load [rad/V].
    load_recovery : float
        Until a tenth of the loss is left [s].
    peak_voltage : float
        Largest voltage of the set-point step [V].
    ripple : float
        Voltage from quantisation at constant speed [V rms].
    """

    rise: float
    settling: float
    overshoot: float
    step_settling: float
    step_overshoot: float
    load_peak: float
    load_integral: float
    load_recovery: float
    peak_voltage: float
    ripple: float


def measure(
    problem: Problem, usual: Plant, controller: Controller, reference: Reference, ripple: float
) -> Performance:
    """Simulate set-point and load steps of one design.

    Parameters
    ----------
    problem : Problem
        Plant and loop.
    usual : Plant
        The same plant with the delay that is usual, for the set-point step.
    controller : Controller
        The design.
    reference : Reference
        How set-points change.
    ripple : float
        From :func:`smp_motor_ident.tune.problem.ripple` [V rms].

    Returns
    -------
    Performance
    """
    T, fb = problem.loop.sample_time, controller.feedback
    change = CHANGE * reference.max_velocity
    horizon = reference.transition_time + 8 * problem.reduced.time_constant
    if fb.i > 0:
        horizon += 4 * (fb.p + 1 / problem.reduced.gain) / fb.i
    time = T * np.arange(min(max(int(horizon / T), 50), 20_000))
    plan = planned_change(usual, reference, change, time)
    run = simulate(usual, controller, plan.low, high=plan.high, forward=plan.forward)
    planned = step_figures(time, run.speed[0], run.voltage[0], change)
    # Small, so that saturation does not hide the loop.
    alone = Controller(fb)
    run_step = simulate(problem.plant, alone, np.ones(time.size))
    abrupt = step_figures(time, run_step.speed[0], run_step.voltage[0], 1.0)
    pushed = simulate(problem.plant, alone, np.zeros(time.size), load=np.ones(time.size))
    load = load_figures(time, pushed.speed[0])
    return Performance(
        rise=planned.rise,
        settling=planned.settling,
        overshoot=planned.overshoot,
        step_settling=abrupt.settling,
        step_overshoot=abrupt.overshoot,
        load_peak=load.peak,
        load_integral=load.integral,
        load_recovery=load.recovery,
        peak_voltage=planned.peak_voltage,
        ripple=ripple,
    )
