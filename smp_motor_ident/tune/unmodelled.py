# SPDX-License-Identifier: Apache-2.0
r"""Unmodelled dynamics as a bound over frequency that the loop must bear.

A motor whose response is ``G (1 + D)`` with ``|D(j w)| <= W(j w)`` keeps a loop stable that is
stable with ``G``, if

    |T(j w)| W(j w) < 1  at all frequencies,

``T`` being the complementary sensitivity.  With an observer, which predicts with the model, only
what goes through the motor counts in its numerator.

References
----------
.. [1] S. Skogestad, I. Postlethwaite, Multivariable Feedback Control, 2nd ed. (2005), sections 7.4
   and 7.5.1.
"""

import math
from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.limits import RESONANCE_ERROR, UNKNOWN_RESPONSE_ERROR


@dataclass(frozen=True, eq=False)
class UnmodelledDynamics:
    """Bound on the relative error of the nominal motor's response."""

    frequency: Array  # shape (b,), [rad/s], rising
    bound: Array  # shape (b,), [-]

    def weight(self, omega: Array) -> Array:
        """Return the bound at some frequencies [rad/s]; nothing is known beyond the last."""
        right = UNKNOWN_RESPONSE_ERROR.value
        bound: Array = np.interp(np.log(omega), np.log(self.frequency), self.bound, right=right)
        return bound

    @property
    def known(self) -> float:
        """Frequency up to which the response is known to less than itself [rad/s]."""
        beyond = np.flatnonzero(self.bound >= 1)
        return float(self.frequency[beyond[0] if beyond.size else -1])


def unmodelled_dynamics(estimate: Estimate) -> UnmodelledDynamics | None:
    """Return the bound of the response's model error; None if the estimate has none.

    A significant error counts with its whole bound, up to that of a resonance; an error above the
    response itself is a resonance, averaged over its band.  An insignificant error is limited to
    the default bound.  Below the lowest excited frequency the bound there applies:
    free masses on springs respond to slower changes as one mass.
    """
    error = estimate.residuals.model_error
    if error is None:
        return None
    shown, bound = np.array(error.shown), np.array(error.bound)
    least = 2 * shown - bound
    taken = np.minimum(
        bound, np.where(least > 0, RESONANCE_ERROR.value, UNKNOWN_RESPONSE_ERROR.value)
    )
    taken = np.where(least > 1, RESONANCE_ERROR.value, taken)
    lowest = int(np.argmax(taken < 1))
    slower = (np.arange(taken.size) < lowest) & ~(least > 0)
    taken = np.where(slower, taken[lowest], taken)
    return UnmodelledDynamics(np.array(error.frequency), taken)


def describe_known_band(unmodelled: UnmodelledDynamics | None, before: str = "; ") -> str:
    """Return up to where the response is known, to be put behind other words."""
    if unmodelled is None or not math.isfinite(unmodelled.known):
        return ""
    return f"{before}the recording shows the motor's response up to {unmodelled.known:.3g} rad/s"
