# SPDX-License-Identifier: Apache-2.0
"""Compute the curves of a design: responses over time and frequency, with bands."""

import math
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.feedback import frequencies
from smp_motor_ident.tune.motors import draw_motors, make_motors
from smp_motor_ident.tune.plant import sample
from smp_motor_ident.tune.problem import noise_density
from smp_motor_ident.tune.reference import STEP_SHARE, controller_for, planned_change
from smp_motor_ident.tune.simulation import Controller, Inputs, simulate

DRAWS = 200
QUANTILES = (0.01, 0.5, 0.99)


@dataclass(frozen=True, eq=False)
class Curves:
    """Curves of one design; bands are rows for 1 %, 50 % and 99 % of the motors."""

    time: Array  # shape (k,), [s]
    reference: Array  # shape (k,), [rad/s, wheel]
    step: Array  # shape (3, k), [rad/s, wheel]: answer to a planned change of the set-point
    load: Array  # shape (3, k), [rad/s, wheel]: answer to a load that takes 1 V
    omega: Array  # shape (f,), [rad/s]
    gain: Array  # shape (3, f): magnitude of the loop gain [-]
    phase: Array  # shape (3, f), [deg]: of the loop gain
    sensitivity: Array  # shape (3, f): magnitude of the sensitivity [-]
    # shape (3, f), [V]: density of the control noise, scaled so that its mean square over the
    # frequencies up to Nyquist is that of the controller's output
    noise: Array


def curves(estimate: Estimate, design: Design) -> Curves:
    """Compute the curves of a design over the distribution of its estimate."""
    loop, ratio = design.loop, design.loop.gear_ratio
    nominal = make_motors(estimate)
    drawn = draw_motors(estimate, DRAWS, np.random.default_rng(0))
    plant = sample(nominal if drawn is None else drawn, loop, believed=nominal)
    controller = controller_for(loop, design.feedback)
    change = STEP_SHARE * design.reference.max_velocity
    slow = float(nominal.a1[0] / nominal.a0[0])
    T = loop.sample_time
    time = T * np.arange(
        int((design.reference.transition_time + 6 * slow) / T) + 2, dtype=np.float64
    )
    usual = replace(loop, delay=loop.expected_delay)
    plan = sample(nominal, usual)
    planned = planned_change(plan, design.reference, change, time)
    as_usual = sample(plant.motors, usual, believed=nominal)
    step = simulate(as_usual, controller, planned.inputs).speed
    push = Inputs(np.zeros(time.size), load=np.ones(time.size))
    pushed = simulate(plant, Controller(design.feedback), push)
    omega = frequencies(T, 1 / slow, 120)
    shown = slice(None, None, math.ceil(time.size / 200))
    control = design.feedback.response(omega, T)
    loop_gain = plant.response(omega) * control
    through = np.abs(control / (1 + loop_gain))
    return Curves(
        time=time[shown],
        reference=planned.reference[shown] / ratio,
        step=_compute_band(step[:, shown]) / ratio,
        load=_compute_band(pushed.speed[:, shown]) / ratio,
        omega=omega,
        gain=_compute_band(np.abs(loop_gain)),
        phase=_compute_band(np.rad2deg(np.unwrap(np.angle(loop_gain), axis=1))),
        sensitivity=_compute_band(np.abs(1 / (1 + loop_gain))),
        noise=_compute_band(through * np.sqrt(noise_density(plant, loop, omega))),
    )


def _compute_band(values: Array) -> Array:
    band: Array = np.quantile(values, QUANTILES, axis=0)
    return band
