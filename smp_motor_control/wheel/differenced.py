# SPDX-License-Identifier: Apache-2.0
"""Fallback gains for differenced counts while the observer is not trusted.

With the longer lag and the quantisation of differenced counts, the observer's gains cause a limit
cycle, and the motor deviates from its model ``G = K e^{-s lag} / (tp s^2 + tau s + 1)``.  The
fallback is a PI controller no faster than the motor (``p K <= 1``, integral time ``tau``: Dahlin's
rule) with ``Re L > -(1 - 1 / Ms)`` for the loop gain ``L``.

References
----------
E. B. Dahlin, *Designing and tuning digital controllers*, Instruments and Control Systems, 1968;
K. J. Astrom and T. Hagglund, *Advanced PID Control*, ISA, 2006, section 4.6.
"""

from dataclasses import replace

import numpy as np

from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.pid import PidGains

MAX_SENSITIVITY = 1.4
"""Maximum sensitivity Ms of the fallback loop, as in the recommended tuning method."""

RESPONSE_LAG_SAMPLES = 1.5
"""Samples from a measurement to the middle of its effect, with one sample of delay."""


def differenced_gains(
    gains: PidGains, model: MotorModel, ratio: float, difference_lag: float, window: int
) -> PidGains:
    """Return gains, at most those given, for counts differenced over ``window`` samples.

    ``difference_lag`` is half a window [s]; ``ratio`` is the gear ratio.
    """
    tau, gain = model.time_constant, model.dc_gain / ratio
    p = gains.p or tau * gains.i
    i = min(gains.i, p / tau)
    lag = model.delay + (1.0 + 2.0 * RESPONSE_LAG_SAMPLES / window) * difference_lag
    s = 1j * np.geomspace(0.01 / (tau + lag), 2.0 * np.pi / lag, 1000)
    response = np.exp(-s * lag) / (model.time_constant_product * s * s + tau * s + 1.0)
    largest_real_part = float((-gain * (p + i / s) * response).real.max())
    share = 1.0 / max(1.0, gain * p, largest_real_part / (1.0 - 1.0 / MAX_SENSITIVITY))
    return replace(gains, p=share * p, i=share * i, d=0.0)
