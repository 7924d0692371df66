"""How a motor's speed decays to its steady value: the homogeneous solution in closed form."""

from __future__ import annotations

import math
from typing import NamedTuple

from smp_motor_control.motor.parameters import MotorParameters


class Coefficients(NamedTuple):
    """Free response after a time t: ``e(t) = g e(0) + h e'(0)``, and its rate's.

    Attributes
    ----------
    g, h : float
        Of the response.
    g_rate, h_rate : float
        Of its rate.
    """

    g: float
    h: float
    g_rate: float
    h_rate: float


class FreeResponse:
    """Solutions of the motor's homogeneous equation ``a2 e'' + a1 e' + a0 e = 0``.

    With the roots ``l1 >= l2`` of the equation, ``h = (e^(l1 t) - e^(l2 t)) / (l1 - l2)``
    and ``g = e^(l1 t) - l1 h``, written so that nothing cancels, from two slow real roots to
    a complex pair to a fast root that is all but algebraic.

    Parameters
    ----------
    parameters : MotorParameters
        The motor.

    Attributes
    ----------
    first_order : bool
        Whether there is no inductance worth the name.
    slow, fast : float
        Real parts of the roots [1/s].
    frequency : float
        Imaginary part of a complex pair [rad/s]; 0 for real roots.
    sum, product : float
        Of the roots; of a motor of second order only.
    """

    def __init__(self, parameters: MotorParameters) -> None:
        a0, a1, a2 = parameters.a0, parameters.a1, parameters.a2
        self.first_order = a2 == 0.0 or not math.isfinite((a1 / a2) ** 2)
        self.frequency = 0.0
        if self.first_order:
            self.slow = -a0 / a1
            self.fast = -math.inf
            return
        self.sum, self.product = -a1 / a2, a0 / a2
        half = self.sum / 2
        discriminant = half * half - self.product
        if discriminant < 0:
            self.frequency = math.sqrt(-discriminant)
            self.slow = self.fast = half
        else:
            self.fast = half - math.sqrt(discriminant)
            self.slow = self.product / self.fast
        self.gap = max(self.slow - self.fast, 0.0)

    def after(self, time: float) -> Coefficients:
        """Return the coefficients of the response after some time.

        Parameters
        ----------
        time : float
            [s].

        Returns
        -------
        Coefficients
            Of deviation and rate at the start.
        """
        slow, fast = self.slow, self.fast
        decay = math.exp(slow * time)
        if self.first_order:
            return Coefficients(decay, 0.0, slow * decay, 0.0)
        if self.frequency > 0:
            cosine = decay * math.cos(self.frequency * time)
            h = decay * math.sin(self.frequency * time) / self.frequency
            return Coefficients(cosine - slow * h, h, -self.product * h, cosine + slow * h)
        h = -decay * math.expm1(-self.gap * time) / self.gap if self.gap > 0 else decay * time
        h_rate = math.exp(fast * time) + slow * h
        return Coefficients(decay - slow * h, h, -self.product * h, h_rate)

    def turning_points(self, deviation: float, rate: float, until: float) -> list[float]:
        """Return the instants at which the response turns round."""
        if self.first_order or until <= 0:
            return []
        if self.frequency > 0:
            across = self.product * deviation - rate * self.slow
            first = (math.atan2(rate * self.frequency, across) % math.pi) / self.frequency
            period = math.pi / self.frequency
            count = max(0, math.ceil((until - first) / period))
            times = [first + k * period for k in range(count)]
        else:
            denominator = -self.slow * (rate - self.fast * deviation)
            if denominator == 0:
                return []
            ratio = rate / denominator
            if self.gap * ratio <= -1:
                return []
            times = [math.log1p(self.gap * ratio) / self.gap if self.gap > 0 else ratio]
        # The instant of breaking loose is a turning point too, up to rounding: not that one.
        shortest = 1e-12 / abs(self.fast)
        return [t for t in times if shortest < t < until]
