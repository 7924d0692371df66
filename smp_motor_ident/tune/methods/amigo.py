"""AMIGO: rules fitted to designs of largest integral gain at a sensitivity of 1.4.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Revisiting the Ziegler-Nichols step response method for PID
   control, J. Process Control 14 (2004), 635-650: equations (6) and (7).
.. [2] K. J. Astrom, T. Hagglund, Advanced PID Control (2006), section 7.5.
"""

from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins


def _solve(problem: Problem) -> Feedback:
    model = problem.reduced
    K, T, L = model.gain, model.time_constant, model.delay
    if problem.structure == "pid":
        p = (0.2 + 0.45 * T / L) / K
        td = 0.5 * L * T / (0.3 * L + T)
        ti = (0.4 * L + 0.8 * T) / (L + 0.1 * T) * L
        return Feedback(p, p / ti, p * td, problem.filter_time(td / 10))
    p = (0.15 + (0.35 - L * T / (L + T) ** 2) * T / L) / K
    return Feedback(p, p / (0.35 * L + 13 * L * T**2 / (T**2 + 12 * L * T + 7 * L**2)))


AMIGO = Method(
    "amigo",
    "AMIGO",
    "Astrom and Hagglund 2004",
    RequiredMargins(phase=45.0, gain=2.0, sensitivity=1.7),
    _solve,
    ("structure",),
)
