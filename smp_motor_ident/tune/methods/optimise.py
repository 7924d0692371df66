"""Direct optimisation of the simulated closed loop.

A population of controllers runs through the same two experiments, a set-point step with
saturation and a load step.  The cost is the time-weighted error of both, relative to SIMC's,
with penalties on overshoot, Ms and control noise; the cross-entropy method moves the population.

References
----------
.. [1] D. Graham, R. C. Lathrop, The synthesis of optimum transient response, Trans. AIEE 72
   (1953), 273-288: ITAE.
.. [2] R. Y. Rubinstein, D. P. Kroese, The Cross-Entropy Method (2004), chapter 5.
"""

from dataclasses import replace
from typing import Any, cast

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.feedback import Feedback, spectral_radius
from smp_motor_ident.tune.methods.simc import SIMC
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins
from smp_motor_ident.tune.simulation import Controller, Inputs, simulate

POPULATION, ELITE, GENERATIONS = 48, 10, 14
REQUIRED = RequiredMargins(phase=45.0, gain=2.0, sensitivity=1.6)


def _solve(problem: Problem) -> Feedback:
    rng = np.random.default_rng(int(problem.targets.get("seed") or 0))
    start = SIMC.solve(replace(problem, targets={}))
    filter_time = problem.filter_time(0.1 * problem.reduced.delay)
    # Coordinates: ln p, ln i, and the derivative time as a share of the delay, from 0.
    centre = np.array([np.log(start.p), np.log(start.i), 0.2])
    width = np.array([0.6, 0.6, 0.3])
    cost = _Cost(problem, start)
    best, least = None, np.inf
    for _ in range(GENERATIONS):
        draws = centre + width * rng.standard_normal((POPULATION, 3))
        draws[0] = centre
        p, i = np.exp(draws[:, 0]), np.exp(draws[:, 1])
        d = p * np.clip(draws[:, 2], 0.0, 1.5) * problem.reduced.delay
        values = cost(p, i, d, filter_time)
        order = np.argsort(values)
        if values[order[0]] < least:
            least = float(values[order[0]])
            k = int(order[0])
            best = Feedback(float(p[k]), float(i[k]), float(d[k]), filter_time if d[k] else 0.0)
        elite = draws[order[:ELITE]]
        centre = elite.mean(axis=0)
        width = 0.3 * width + 0.7 * elite.std(axis=0)
    if best is None or spectral_radius(problem.plant, best)[0] >= 1:
        raise DesignError("the search found no stable loop; shorten the delay or sample faster")
    return best


class _Cost:
    """Cost of a population of controllers on one plant."""

    def __init__(self, problem: Problem, start: Feedback) -> None:
        self.problem = problem
        T, model = problem.loop.sample_time, problem.reduced
        span = 6 * (model.delay + model.time_constant)
        self.time = T * np.arange(1, max(int(span / T), 40) + 1)
        speed = 0.3 * problem.loop.supply_voltage * model.gain
        self.step = np.full(self.time.size, speed)
        self.scale: Array = np.ones(2)
        p, i, d = (np.array([x]) for x in (start.p, start.i, start.d))
        self.scale = self._errors(p, i, d, 0.0)[0][:, 0]

    def _errors(self, p: Array, i: Array, d: Array, filter_time: float) -> tuple[Array, Array]:
        """Return the time-weighted errors of set-point and load step, and the overshoot."""
        plant = self.problem.plant.repeated(p.size)
        gains = Feedback(cast(Any, p), cast(Any, i), cast(Any, d), filter_time)
        with np.errstate(over="ignore", invalid="ignore"):
            limited = Controller(
                gains, limit=self.problem.loop.supply_voltage, tracking=cast(Any, p / i)
            )
            step = simulate(plant, limited, Inputs(self.step)).speed / self.step
            push = Inputs(np.zeros(self.time.size), load=np.ones(self.time.size))
            load = simulate(plant, Controller(gains), push).speed
            errors = np.stack([np.abs(1 - step) @ self.time, np.abs(load) @ self.time])
        over = np.maximum(step.max(axis=1) - 1, 0)
        return errors / self.scale[:, None], over

    def __call__(self, p: Array, i: Array, d: Array, filter_time: float) -> Array:
        problem = self.problem
        errors, over = self._errors(p, i, d, filter_time)
        column = [cast(Any, gain[:, None]) for gain in (p, i, d)]
        each = Feedback(column[0], column[1], column[2], filter_time)
        control, back = problem.closed(each)
        peak = np.abs(back).max(axis=1)
        excess = np.maximum(peak - REQUIRED.sensitivity, 0) * 20
        excess += (
            np.maximum(problem.noise_rms(control * back) / problem.loop.noise_limit - 1, 0) * 20
        )
        value = errors.sum(axis=0) + 10 * np.maximum(over - 0.1, 0) + excess
        return np.where(np.isfinite(value), value, 1e9)


OPTIMISE = Method(
    "optimise",
    "least time-weighted error of the simulated loop",
    "Graham and Lathrop 1953",
    REQUIRED,
    _solve,
    (),
)
