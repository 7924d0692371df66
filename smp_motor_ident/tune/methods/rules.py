# SPDX-License-Identifier: Apache-2.0
"""Published rules: SIMC, and those from the ultimate gain and period.

SIMC makes the closed loop of first order, as fast as the delay allows, or slower on request.  The
ultimate point is that of the model in the sampled loop, with its hold and delay.

References
----------
.. [1] S. Skogestad, Simple analytic rules for model reduction and PID controller tuning,
   J. Process Control 13 (2003), 291-309: half rule and equations (23) to (25).
.. [2] J. G. Ziegler, N. B. Nichols, Optimum settings for automatic controllers,
   Trans. ASME 64 (1942), 759-768.
.. [3] B. D. Tyreus, W. L. Luyben, Tuning PI controllers for integrator/dead time processes,
   Ind. Eng. Chem. Res. 31 (1992), 2625-2628; PID values: W. L. Luyben, M. L. Luyben,
   Essentials of Process Control (1997), p. 97.
"""

from dataclasses import replace

from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins

RULES = {
    # rule, structure: gain as a share of Ku, integral and derivative time as shares of Tu
    ("ziegler_nichols", "pi"): (0.45, 1 / 1.2, 0.0),
    ("ziegler_nichols", "pid"): (0.6, 0.5, 0.125),
    ("tyreus_luyben", "pi"): (1 / 3.2, 2.2, 0.0),
    ("tyreus_luyben", "pid"): (1 / 2.2, 2.2, 1 / 6.3),
}


def _solve_simc(problem: Problem) -> Feedback:
    model = problem.reduced
    wished = problem.target("closed_loop_time_constant", model.delay)
    p = model.time_constant / (model.gain * (wished + model.delay))
    return Feedback(p, p / min(model.time_constant, 4 * (wished + model.delay)))


def _solve_ultimate(problem: Problem, rule: str) -> Feedback:
    ruled = apply_rule(rule, problem.structure or "pi", *problem.ultimate)
    if not ruled.d:
        return ruled
    return replace(ruled, filter_time=problem.filter_time(ruled.filter_time))


def apply_rule(rule: str, structure: str, gain: float, period: float) -> Feedback:
    """Apply a rule to an ultimate point without a model."""
    share, integral, derivative = RULES[rule, structure]
    p, td = share * gain, derivative * period
    return Feedback(p, p / (integral * period), p * td, td / 10)


SIMC = Method(
    "simc",
    "SIMC, closed loop as fast as the delay",
    "Skogestad 2003",
    RequiredMargins(phase=45.0, gain=2.0, sensitivity=1.7),
    _solve_simc,
    ("closed_loop_time_constant",),
)
ZIEGLER_NICHOLS = Method(
    "ziegler_nichols",
    "Ziegler-Nichols from the ultimate point",
    "Ziegler and Nichols 1942",
    RequiredMargins(phase=20.0, gain=1.5, sensitivity=3.5),
    lambda problem: _solve_ultimate(problem, "ziegler_nichols"),
    ("structure",),
)
TYREUS_LUYBEN = Method(
    "tyreus_luyben",
    "Tyreus-Luyben from the ultimate point",
    "Tyreus and Luyben 1992",
    RequiredMargins(phase=30.0, gain=2.0, sensitivity=2.2),
    lambda problem: _solve_ultimate(problem, "tyreus_luyben"),
    ("structure",),
)
