# SPDX-License-Identifier: Apache-2.0
"""Dominant pole placement: two gains place one pair of closed-loop poles.

With delay, hold and window in the loop there are more poles than gains; the pair is placed
exactly in the sampled loop, the others are looked at and decide how fast it may be.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Advanced PID Control (2006), section 6.4.
"""

import math

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.feedback import Feedback, spectral_radius
from smp_motor_ident.tune.margins import batch_margins
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins

REQUIRED = RequiredMargins(phase=45.0, gain=2.0, sensitivity=1.7)


def place(problem: Problem, natural_frequency: float, damping: float) -> Feedback:
    r"""Return the PI gains that put a pole pair at ``exp(T (-zeta wn +- j wn sqrt(1-zeta^2)))``.

    The characteristic equation ``1 + P(z) (p + i T / (z - 1)) = 0`` at that point is linear in
    the gains: two real equations for two numbers.
    """
    T = problem.loop.sample_time
    pole = natural_frequency * (-damping + 1j * math.sqrt(1 - damping**2))
    z = np.exp(pole * T)
    needed = -1 / problem.plant.transfer(np.array([z]))[0, 0]
    integral = T / (z - 1)
    i = float(needed.imag / integral.imag)
    return Feedback(float(needed.real - i * integral.real), i)


def _solve(problem: Problem) -> Feedback:
    damping = problem.target("damping", 0.8)
    if damping >= 1:
        raise DesignError(f"damping is {damping}; a pair of poles needs one below 1")
    limit, nearest = _fastest(problem, damping)
    wished = problem.targets.get("natural_frequency")
    if wished is None:
        return nearest
    wished = problem.target("natural_frequency", limit)
    feedback = place(problem, wished, damping)
    if not _is_dominant(problem, feedback, wished * damping):
        raise DesignError(
            f"natural_frequency {wished:.4g} rad/s with damping {damping:g} leaves the loop "
            f"below a phase margin of {REQUIRED.phase:g} deg or above Ms {REQUIRED.sensitivity:g}; "
            f"the nearest design that holds has {limit:.4g} rad/s"
        )
    return feedback


def _is_dominant(problem: Problem, feedback: Feedback, decay: float) -> bool:
    """Return whether the placed pair, of decay rate ``decay`` [1/s], dominates and holds."""
    slowest = math.exp(-0.8 * decay * problem.loop.sample_time)
    if feedback.i <= 0 or spectral_radius(problem.plant, feedback)[0] > slowest:
        return False
    loop = problem.response * feedback.response(problem.omega, problem.loop.sample_time)
    m = batch_margins(loop[None], problem.omega)
    return bool(m.phase[0] >= REQUIRED.phase and m.sensitivity[0] <= REQUIRED.sensitivity)


def _fastest(problem: Problem, damping: float) -> tuple[float, Feedback]:
    best: tuple[float, Feedback] | None = None
    corner = 1 / problem.reduced.time_constant
    for frequency in np.geomspace(0.3 * corner, 0.6 * math.pi / problem.loop.sample_time, 60):
        feedback = place(problem, float(frequency), damping)
        if _is_dominant(problem, feedback, float(frequency) * damping):
            best = float(frequency), feedback
    if best is None:
        raise DesignError(
            f"no pole pair of damping {damping:g} keeps Ms below {REQUIRED.sensitivity:g}; ask for "
            "another damping or use the method 'margin'"
        )
    return best


POLE_PLACEMENT = Method(
    "pole_placement",
    "dominant pole pair, fastest that holds its margin",
    "Astrom and Hagglund 2006, section 6.4",
    REQUIRED,
    _solve,
    ("natural_frequency", "damping"),
)
