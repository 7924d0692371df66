# SPDX-License-Identifier: Apache-2.0
"""Simulate a design: figures of the nominal loop, and bands over the ensemble."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array
from smp_motor_control.wheel.plausibility import LOAD_SHARE
from smp_motor_ident.limits import MAX_STATED_GAIN_MARGIN, MIN_OUTLIER_DEVIATIONS
from smp_motor_ident.tune.case import REQUIRED_SHARE, Case
from smp_motor_ident.tune.feedback import BatchMargins, Feedback, Margins
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.plant import Plant, sample
from smp_motor_ident.tune.problem import Problem
from smp_motor_ident.tune.reference import STEP_SHARE, Change, Reference, planned_change
from smp_motor_ident.tune.simulation import (
    Controller,
    Inputs,
    StepFigures,
    draw_white_noise,
    find_last_exit,
    simulate,
    step_figures,
)
from smp_motor_ident.tune.unmodelled import compute_resonance_effect


@dataclass(frozen=True)
class Performance:
    """Figures of the simulated loop; speeds at the motor shaft."""

    # rise, settling: of a set-point step through the reference [s]: 10 to 90 %, and until within
    # 2 %
    rise: float
    settling: float
    overshoot: float  # of the same [%]
    # step_settling, step_overshoot: the same for an abrupt step with the feedback gains alone
    step_settling: float
    step_overshoot: float
    load_peak: float  # speed lost per volt of load [rad/s/V]
    load_integral: float  # integral of the magnitude of the error per volt of load [rad/V]
    load_recovery: float  # until a tenth of the loss is left [s]
    peak_voltage: float  # largest voltage of the set-point step [V]
    control_noise: float  # voltage from the measurement's noise at constant speed [V rms]


@dataclass(frozen=True)
class Band:
    """A figure of the nominal loop, and its range over 99 % of the uncertain motors."""

    # value, low, high: NaN if undefined, such as the settling time of a loop that does not settle
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Specification:
    """Bands of the answer to a change of set-point from rest, and of the margins.

    Simulated with counts, dry friction and the usual delay, over the uncertain motors, plus the
    effect of resonances that the recording does not exclude.  Margins are for the longest delay.
    """

    samples: int  # motors that the bands are over; 0 where the estimate has no uncertainty
    change: float  # of the set-point [rad/s, motor]
    overshoot: Band  # [%]
    settling: Band  # until within 2 % [s]
    # phase_margin, gain_margin, sensitivity: [deg], [-], [-]
    phase_margin: Band
    gain_margin: Band
    sensitivity: Band


@dataclass(frozen=True)
class Settling:
    """Settling of a change of set-point from rest, with the parts that the figure includes."""

    value: float  # of the motor as identified [s]
    high: float  # of 99 % of the motors within the uncertainty [s]
    tolerance: float  # band around the set-point [share of the change]
    change: float  # of the set-point [rad/s, wheel]
    transition: float  # duration of the planned change, which is in the figures [s]
    common: bool  # whether that is common to several wheels
    abrupt: float  # of an abrupt change, by the feedback gains alone [s]

    def describe(self) -> str:
        """Return it in words."""
        high = "not stated" if math.isnan(self.high) else f"{1e3 * self.high:.3g} ms"
        wheels = ", common to all wheels" if self.common else ""
        return (
            f"settles within {100 * self.tolerance:.0f} % in {1e3 * self.value:.3g} ms "
            f"(at most {high}) after a change of set-point by {self.change:.3g} rad/s, its planned "
            f"transition of {1e3 * self.transition:.3g} ms included{wheels}; an abrupt change, by "
            f"feedback alone, in {1e3 * self.abrupt:.3g} ms"
        )


DRAWS = 300
"""Largest number of motors behind the bands; fewer if a change takes many samples."""

WORK, MIN_DRAWS = 1e6, 100
"""Largest number of simulated samples, and smallest number of motors."""


def compute_figures(
    case: Case, usual: Plant, controller: Controller, reference: Reference,
    kept: tuple[Margins, BatchMargins], control_noise: float,
) -> tuple[Performance, Specification]:  # fmt: skip
    """Simulate a design with the margins ``kept``: the nominal and the uncertain motors."""
    problem, (margins, found) = case.problem, kept
    loop = replace(problem.loop, delay=problem.loop.expected_delay)
    change = STEP_SHARE * reference.max_velocity
    time = _list_instants(problem, controller.feedback, reference)
    plan = planned_change(usual, reference, change, time)
    run = simulate(usual, controller, plan.inputs)
    planned = step_figures(time, run.speed[0], run.voltage[0], change)
    answer = run.speed[0] / change
    figures = _measure_performance(problem, controller.feedback, time, planned, control_noise)
    each = _simulate_ensemble(case, controller, loop, plan, change, time)
    gain = band(margins.gain, found.gain)
    more, longer = compute_resonance_effect(problem.unmodelled, usual, controller.feedback, answer)
    return figures, Specification(
        samples=len(each) if case.drawn else 0,
        change=change,
        overshoot=band(figures.overshoot, [one.overshoot for one in each], 100 * more),
        settling=band(figures.settling, [one.settling for one in each], longer),
        phase_margin=band(margins.phase, found.phase),
        # The low end is at most what a record can show
        gain_margin=replace(gain, low=min(gain.low, MAX_STATED_GAIN_MARGIN)),
        sensitivity=band(margins.sensitivity, found.sensitivity),
    )


def _simulate_ensemble(
    case: Case, controller: Controller, loop: Loop, plan: Change, change: float, time: Array
) -> list[StepFigures]:
    """Simulate a change of every uncertain motor, with counts, noise, friction and driver."""
    nominal = case.problem.plant.motors
    drawn = case.ensemble.plant.motors.first(max(int(min(DRAWS, WORK / time.size)), MIN_DRAWS))
    motors = drawn if case.drawn else nominal
    plant = sample(motors, loop, believed=nominal)
    shape = (len(plant), time.size)
    counted = _mark_counted(plant, case.problem.plant)
    forward = plan.forward + case.lost_voltage * plan.friction
    most = min(math.sqrt(3.0) * case.scatter / loop.sample_time, 1.0)
    late = np.random.default_rng(3).uniform(-most, most, shape)  # of each step [samples]
    run = simulate(
        plant,
        controller,
        replace(
            plan.inputs,
            forward=forward,
            load=_draw_loads(case, plant.motors.static_voltage, shape)
            + late * np.diff(forward, prepend=forward[0]),
            noise=_draw_noise(case, loop, shape)
            + late * np.diff(plan.reference, prepend=plan.reference[0]),
            angle_noise=draw_white_noise(loop.angle_noise, shape) * counted[:, None],
        ),
        count_angle=np.where(counted, loop.count_angle, 0.0),
        speed_step=loop.rounding,
        eccentric=np.where(counted, case.eccentric, 0.0),
        friction=motors.static_voltage if case.drawn else np.array([case.friction.known]),
        modelled=case.lost_voltage,
        driver=case.driver,
    )
    each = [
        step_figures(time, speed, volts, change)
        for speed, volts in zip(run.speed, run.voltage, strict=True)
    ]
    # The running loop without the observer was not simulated.
    return [
        replace(one, settling=math.nan) if other else one
        for one, other in zip(each, run.contradicted, strict=True)
    ]


def _mark_counted(plant: Plant, nominal: Plant) -> NDArray[np.bool_]:
    """Tell for each motor whether the running loop's speed is made from counts.

    A filtered speed is not, nor that of an alternative with a much shorter window than the nominal
    one, whose quantisation the recording would show.
    """
    shortest = 0.5 * nominal.window_length[0]
    made = (shortest > 0) & (plant.window_length >= shortest) & (plant.motors.sensor_lag == 0)
    return np.asarray(made | (plant.observer is not None))


def _draw_loads(case: Case, friction: Array, shape: tuple[int, int]) -> Array:
    """Return the load beyond the voltage at rest before the change [V].

    Friction holds the wheel at rest within a range of voltages; half of the draws begin at either
    end.
    """
    either = np.where(np.arange(shape[0]) // 2 % 2, -1.0, 1.0)
    held: Array = (either * np.minimum(case.load, friction))[:, None]
    return held + draw_white_noise(case.torque_noise, shape, 1)


def _draw_noise(case: Case, loop: Loop, shape: tuple[int, int]) -> Array:
    """Return the noise of the reported speed, with the outliers that the running loop believes.

    They have any size up to the top speed; the loop rejects changes impossible for a motor.
    """
    rounding = loop.rounding**2 / 12
    deviation = math.sqrt(max(loop.reported_noise**2 - rounding, 0.0))
    noise = draw_white_noise(deviation, shape)
    if not (deviation and case.outliers):
        return noise
    motor = case.problem.plant.motors
    top = loop.supply_voltage / float(motor.a0[0])
    load = LOAD_SHARE * loop.supply_voltage + case.lost_voltage
    believed = (
        MIN_OUTLIER_DEVIATIONS * loop.reported_noise + load / float(motor.a1[0]) * loop.sample_time
    )
    rng = np.random.default_rng(2)
    there = rng.random(shape) < case.outliers * min(believed / top, 1.0)
    return np.asarray(noise + np.where(there, believed * rng.uniform(-1.0, 1.0, shape), 0.0))


def _measure_performance(
    problem: Problem, feedback: Feedback, time: Array, planned: StepFigures, control_noise: float
) -> Performance:
    """Add figures of the feedback alone, by a change so small that nothing saturates."""
    alone = Controller(feedback)
    run = simulate(problem.plant, alone, Inputs(np.ones(time.size)))
    abrupt = step_figures(time, run.speed[0], run.voltage[0], 1.0)
    push = Inputs(np.zeros(time.size), load=np.ones(time.size))
    loss = np.abs(simulate(problem.plant, alone, push).speed[0])
    return Performance(
        **vars(planned),
        step_settling=abrupt.settling,
        step_overshoot=abrupt.overshoot,
        load_peak=float(loss.max()),
        load_integral=float(np.trapezoid(loss, time)),
        load_recovery=float(find_last_exit(time, loss > 0.1 * loss.max())),
        control_noise=control_noise,
    )


def band(value: float, over: Sequence[float] | Array, added: float = 0.0) -> Band:
    """Return a figure's band, whose high end is raised by ``added``."""
    rising = np.sort(np.asarray(over, dtype=np.float64))  # NaN last
    beyond = int((1 - REQUIRED_SHARE) * (rising.size - 1))
    low, high = np.fmin(rising[beyond], value), np.maximum(rising[-1 - beyond], value)
    return Band(value, float(low), float(high) + added)


def _list_instants(problem: Problem, fb: Feedback, reference: Reference) -> Array:
    """Return the instants over which a change of set-point is simulated, until it is over."""
    T = problem.loop.sample_time
    span = reference.transition_time + 8 * problem.reduced.time_constant
    if fb.i > 0:
        span += 4 * (fb.p + 1 / problem.reduced.gain) / fb.i
    return T * np.arange(min(max(int(span / T), 50), 20_000), dtype=np.float64)
