"""Gains for a wheel whose observer is contradicted by its counts: a PI on their difference.

On a speed that is later, and in counts, the gains that the observer bears act as a relay.  And the
motor is not what its model ``G = K e^{-s lag} / (tp s^2 + tau s + 1)`` says: the loop is to be no
faster than the motor itself (``p K <= 1`` with an integral time of ``tau``, Dahlin's rule), and
``Re L > -(1 - 1 / Ms)`` keeps its gain ``L`` away from -1 as a sensitivity Ms does.

References
----------
E. B. Dahlin, *Designing and tuning digital controllers*, Instruments and Control Systems, 1968;
K. J. Astrom and T. Hagglund, *Advanced PID Control*, ISA, 2006, section 4.6.
"""

from dataclasses import replace

import numpy as np

from smp_motor_control.motor.model import MotorModel
from smp_motor_control.pid import PidGains

SENSITIVITY = 1.4
"""Largest sensitivity Ms of that loop: what the recommended method asks for."""

ANSWER = 1.5
"""Samples from a measurement to the middle of what it causes: its answer acts one sample late."""


def differenced_gains(
    gains: PidGains, model: MotorModel, ratio: float, late: float, window: int
) -> PidGains:
    """Return gains, no larger than those given, for counts differenced over ``window`` samples.

    Their difference is ``late`` by half of the window [s]; ``ratio`` is the gear's.
    """
    tau, gain = model.time_constant, model.dc_gain / ratio
    p = gains.p or tau * gains.i
    i = min(gains.i, p / tau)
    lag = model.delay + (1.0 + 2.0 * ANSWER / window) * late
    s = 1j * np.geomspace(0.01 / (tau + lag), 2.0 * np.pi / lag, 1000)
    response = np.exp(-s * lag) / (model.time_constant_product * s * s + tau * s + 1.0)
    nearest = float((-gain * (p + i / s) * response).real.max())
    share = 1.0 / max(1.0, gain * p, nearest / (1.0 - 1.0 / SENSITIVITY))
    return replace(gains, p=share * p, i=share * i, d=0.0)
