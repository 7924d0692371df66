"""SIMC and lambda tuning: a first-order closed loop as fast as the delay allows.

References
----------
.. [1] S. Skogestad, Simple analytic rules for model reduction and PID controller tuning,
   J. Process Control 13 (2003), 291-309: half rule and equations (23) to (25).
.. [2] E. B. Dahlin, Designing and tuning digital controllers, Instruments and Control
   Systems 41 (1968), 77-83; D. E. Rivera, M. Morari, S. Skogestad, Internal model control 4,
   Ind. Eng. Chem. Process Des. Dev. 25 (1986), 252-265.
"""

from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins


def _simc(problem: Problem) -> Feedback:
    model = problem.reduced
    wished = problem.target("closed_loop_time_constant", model.delay)
    p = model.time_constant / (model.gain * (wished + model.delay))
    return Feedback(p, p / min(model.time_constant, 4 * (wished + model.delay)))


def _lambda(problem: Problem) -> Feedback:
    model = problem.reduced
    wished = problem.target("closed_loop_time_constant", max(model.time_constant, model.delay))
    p = model.time_constant / (model.gain * (wished + model.delay))
    return Feedback(p, p / model.time_constant)


REQUIRED = RequiredMargins(phase=45.0, gain=2.0, sensitivity=1.7)
SIMC = Method(
    "simc",
    "SIMC, closed loop as fast as the delay",
    "Skogestad 2003",
    REQUIRED,
    _simc,
    ("closed_loop_time_constant",),
)
LAMBDA = Method(
    "lambda",
    "lambda, closed loop as fast as the motor",
    "Dahlin 1968; Rivera, Morari and Skogestad 1986",
    REQUIRED,
    _lambda,
    ("closed_loop_time_constant",),
)
