"""Which other motors would have given the same recording: why some parameters are not printed."""

from __future__ import annotations

import math

from smp_motor_ident.result import Estimate


def same_response(estimate: Estimate) -> dict[str, tuple[float, float]]:
    """Return the ranges of L, K, J and b over all motors of the identified response.

    With ``a0 = (R b + K^2)/K``, ``a1 = (R J + L b)/K``, ``a2 = L J/K`` and R known, each K gives
    ``b = K (a0 - K)/R`` and J as a root of ``R J^2 - a1 K J + a2 K b = 0``, then L.  Both are
    real and not negative for ``max(0, a0 - a1^2/(4 a2)) <= K <= a0``.  At ``K = a0`` (b = 0) the
    larger root is ``a1 a0/R``, the smaller one vanishes and takes L to infinity.

    References
    ----------
    docs/derivations.md, what voltage and speed can tell.
    """
    gain, lag = estimate.value("dc_gain"), estimate.value("time_constant")
    product, resistance = estimate.value("time_constant_product"), estimate.value("resistance")
    if "motor_constant" not in estimate.unidentifiable or min(gain, lag, product, resistance) <= 0:
        return {}
    a0, a1, a2 = 1 / gain, lag / gain, product / gain
    lowest = max(a0 - a1**2 / (4 * a2), 0.0)
    steepest = max(lowest, a0 / 2)  # where K (a0 - K) is largest
    return {
        "inductance": (a2 * resistance / a1, math.inf),
        "motor_constant": (lowest, a0),
        "inertia": (0.0, a1 * a0 / resistance),
        "viscous_friction": (0.0, steepest * (a0 - steepest) / resistance),
    }
