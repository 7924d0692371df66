# SPDX-License-Identifier: Apache-2.0
"""Check gains for the motors within the uncertainty of the estimate."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_ident.tune.feedback import Feedback, spectral_radius
from smp_motor_ident.tune.margins import BatchMargins, batch_margins, make_grid
from smp_motor_ident.tune.plant import Plant
from smp_motor_ident.tune.problem import Problem, RequiredMargins

REQUIRED_SHARE = 0.99  # share of the distribution for which the required margins must hold


@dataclass(frozen=True)
class Robustness:
    """Stability and margins over the distribution of the estimate."""

    samples: int  # motors drawn; 0 where the estimate has no uncertainty
    stable: float  # share with a stable loop [0..1]
    holds: float  # share that keeps every required margin [0..1]
    # phase, gain, sensitivity: phase margin [deg], gain margin [-] and Ms [-] of the worst percent
    phase: float
    gain: float
    sensitivity: float
    unmodelled: float = 0.0  # largest |T| W of unmodelled dynamics [-]; stable below 1


class UncertaintyEnsemble:
    """Assessment of gains over a batch of motors, whose response is computed once."""

    def __init__(
        self, plant: Plant, required: RequiredMargins, nominal: Problem | None = None
    ) -> None:
        self.plant = plant
        self.required = required
        self.nominal = nominal  # whose unmodelled dynamics the gains must bear
        self.omega = make_grid(plant, 200)
        self.response = plant.response(self.omega)

    def margins(self, feedback: Feedback) -> BatchMargins:
        """Return the margins of every motor of the batch."""
        loop = self.response * feedback.response(self.omega, self.plant.sample_time)
        return batch_margins(loop, self.omega)

    def assess(self, feedback: Feedback) -> Robustness:
        """Return stability and margins over the batch."""
        m = self.margins(feedback)
        stable = spectral_radius(self.plant, feedback) < 1
        p = self.required
        # A hundredth of slack: the grid's resolution.
        holds = stable & (m.phase >= 0.99 * p.phase) & (m.gain >= 0.99 * p.gain)
        holds &= m.sensitivity <= 1.01 * p.sensitivity
        unmodelled = 0.0 if self.nominal is None else self.nominal.unmodelled_gain(feedback)
        holds &= unmodelled <= 1.01
        low, high = 1 - REQUIRED_SHARE, REQUIRED_SHARE
        return Robustness(
            samples=len(self.plant),
            stable=float(np.mean(stable)),
            holds=float(np.mean(holds)),
            phase=float(np.quantile(m.phase, low, method="lower")),
            gain=float(np.quantile(m.gain, low, method="lower")),
            sensitivity=float(np.quantile(m.sensitivity, high, method="higher")),
            unmodelled=unmodelled,
        )


def back_off(
    assess: Callable[[Feedback], Robustness], feedback: Feedback
) -> tuple[Feedback, float, Robustness]:
    """Scale gains down until 99 % of the motors keep the required margins.

    Proportional and derivative action shrink with the factor, integral action with its square,
    so that the loop keeps its shape while its crossover moves down.
    """
    found = assess(feedback)
    if found.holds >= REQUIRED_SHARE:
        return feedback, 1.0, found
    good, bad = None, 1.0
    factor = 0.97
    while factor > 0.01:
        trial = reduce_crossover(feedback, factor)
        found = assess(trial)
        if found.holds >= REQUIRED_SHARE:
            good = factor, trial, found
            break
        bad, factor = factor, factor * factor
    if good is None:
        return feedback, 0.0, assess(feedback)
    for _ in range(6):
        middle = 0.5 * (good[0] + bad)
        trial = reduce_crossover(feedback, middle)
        found = assess(trial)
        if found.holds >= REQUIRED_SHARE:
            good = middle, trial, found
        else:
            bad = middle
    return good[1], good[0], good[2]


def reduce_crossover(feedback: Feedback, factor: float) -> Feedback:
    """Return gains with a lower crossover and the same shape of the loop."""
    return replace(feedback.scaled(factor), i=feedback.i * factor**2)
