# SPDX-License-Identifier: Apache-2.0
r"""Exact response of a linear motor, for one motor or a batch.

The deviation e of the speed from its steady value ``K u`` obeys

    tp e'' + tau e' + e = 0,    tp = time_constant_product,    tau = time_constant.

With the roots ``l1 >= l2`` of ``tp s^2 + tau s + 1``,

    e(t) = g e(0) + h e'(0),   h = (e^(l1 t) - e^(l2 t)) / (l1 - l2),   g = e^(l1 t) - l1 h,

written without cancellation or overflow for complex roots and for arbitrarily fast ones.
Integrating the equation once gives the angle:
``int e = tau (e(0) - e(t)) + tp (e'(0) - e'(t))``.

References
----------
K. J. Astrom, B. Wittenmark, *Computer-Controlled Systems*, 3rd ed. (1997), section 2.3:
sampling with a zero-order hold.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from smp_motor_control.arrays import Array

MAX_FIRST_ORDER_RATIO = 1e-14
"""Largest ``tp / tau^2`` of a motor treated as first order; its response differs by 1e-14."""


class Coefficients(NamedTuple):
    """Coefficients of the free response, ``e(t) = g e(0) + h e'(0)``, and of its rate."""

    g: float
    h: float
    g_rate: float
    h_rate: float


class FreeResponse:
    """Free response of one motor; scalar, for real-time loops.

    Arguments are the sum of the time constants [s] and their product [s^2], 0 for first order.
    ``slow`` and ``fast`` are the real parts of the roots [1/s], ``frequency`` is the imaginary part
    of a complex pair [rad/s].
    """

    def __init__(self, time_constant: float, product: float) -> None:
        self.time_constant, self.product = time_constant, product
        self.first_order = product <= MAX_FIRST_ORDER_RATIO * time_constant * time_constant
        self.frequency = self.gap = 0.0
        if self.first_order:
            self.product = 0.0
            self.slow, self.fast = -1.0 / time_constant, -math.inf
            return
        # Roots of product s^2 + time_constant s + 1
        mean = -0.5 * time_constant / product
        discriminant = mean * mean - 1.0 / product
        if discriminant < 0.0:
            self.frequency = math.sqrt(-discriminant)
            self.slow = self.fast = mean
            return
        self.fast = mean - math.sqrt(discriminant)
        self.slow = 1.0 / (product * self.fast)
        self.gap = max(self.slow - self.fast, 0.0)

    def after(self, time: float) -> Coefficients:
        """Return the coefficients after a time [s]."""
        slow = self.slow
        decay = math.exp(slow * time)
        if self.first_order:
            return Coefficients(decay, 0.0, slow * decay, 0.0)
        if self.frequency > 0.0:
            cosine = decay * math.cos(self.frequency * time)
            h = decay * math.sin(self.frequency * time) / self.frequency
            return Coefficients(cosine - slow * h, h, -h / self.product, cosine + slow * h)
        h = -decay * math.expm1(-self.gap * time) / self.gap if self.gap > 0.0 else decay * time
        h_rate = math.exp(self.fast * time) + slow * h
        return Coefficients(decay - slow * h, h, -h / self.product, h_rate)

    def integral(self, fall: float, rate_fall: float) -> float:
        """Return the integral of the deviation, given its decrease and that of its rate."""
        return self.time_constant * fall + self.product * rate_fall

    def turning_points(self, deviation: float, rate: float, until: float) -> list[float]:
        """Return the instants before ``until`` at which the rate is zero [s]."""
        if self.first_order or until <= 0.0:
            return []
        if self.frequency > 0.0:
            across = deviation / self.product - rate * self.slow
            first = (math.atan2(rate * self.frequency, across) % math.pi) / self.frequency
            period = math.pi / self.frequency
            count = max(0, math.ceil((until - first) / period))
            times = [first + k * period for k in range(count)]
        else:
            denominator = -self.slow * (rate - self.fast * deviation)
            if denominator == 0.0:
                return []
            ratio = rate / denominator
            if self.gap * ratio <= -1.0:
                return []
            times = [math.log1p(self.gap * ratio) / self.gap if self.gap > 0.0 else ratio]
        # Skip the instant of break-away, which is a turning point up to rounding.
        shortest = 1e-12 / abs(self.fast)
        return [t for t in times if shortest < t < until]


class HeldResponse(NamedTuple):
    """Discrete model of n motors under constant voltage u, with state ``x = (w, w')``.

    ``x <- transition x + forced u`` and ``angle += angle_transition x + angle_forced u``.
    """

    transition: Array  # shape (n, 2, 2)
    forced: Array  # shape (n, 2)
    angle_transition: Array  # shape (n, 2)
    angle_forced: Array  # shape (n,)


def zero_order_hold(
    dc_gain: ArrayLike, time_constant: ArrayLike, product: ArrayLike, interval: ArrayLike
) -> HeldResponse:
    """Return the exact discrete model of a batch of motors, arguments of shape (n,) or ().

    A ``product`` of 0 gives a first-order motor, whose acceleration follows speed and voltage.
    """
    given = (dc_gain, time_constant, product, interval)
    gain, tau, tp, t = np.broadcast_arrays(*(np.atleast_1d(np.asarray(x, float)) for x in given))
    motors = [FreeResponse(*constants) for constants in zip(tau.tolist(), tp.tolist())]
    tp = np.array([one.product for one in motors])
    g, h, g_rate, h_rate = np.array([one.after(x) for one, x in zip(motors, t.tolist())]).T
    swept = tau * (1.0 - g) - tp * g_rate
    return HeldResponse(
        np.stack((np.stack((g, h), axis=-1), np.stack((g_rate, h_rate), axis=-1)), axis=-2),
        np.stack((gain * (1.0 - g), -gain * g_rate), axis=-1),
        np.stack((swept, tp * (1.0 - g)), axis=-1),
        gain * (t - swept),
    )
