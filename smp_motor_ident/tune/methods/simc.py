# SPDX-License-Identifier: Apache-2.0
"""SIMC: a first-order closed loop as fast as the delay allows, or slower on request.

References
----------
.. [1] S. Skogestad, Simple analytic rules for model reduction and PID controller tuning,
   J. Process Control 13 (2003), 291-309: half rule and equations (23) to (25).
"""

from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins


def _solve(problem: Problem) -> Feedback:
    model = problem.reduced
    wished = problem.target("closed_loop_time_constant", model.delay)
    p = model.time_constant / (model.gain * (wished + model.delay))
    return Feedback(p, p / min(model.time_constant, 4 * (wished + model.delay)))


SIMC = Method(
    "simc",
    "SIMC, closed loop as fast as the delay",
    "Skogestad 2003",
    RequiredMargins(phase=45.0, gain=2.0, sensitivity=1.7),
    _solve,
    ("closed_loop_time_constant",),
)
