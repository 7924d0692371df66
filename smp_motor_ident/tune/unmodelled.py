# SPDX-License-Identifier: Apache-2.0
r"""Bound the unmodelled dynamics over frequency, for a robust loop.

A motor whose response is ``G (1 + D)`` with ``|D(j w)| <= W(j w)`` keeps a loop stable that is
stable with ``G``, if

    |T(j w)| W(j w) < 1  at all frequencies,

``T`` being the complementary sensitivity.  With an observer, which predicts with the model, only
what goes through the motor counts in its numerator.

One that the recording does not exclude is a mass on a spring,

    D(s) = m s^2 / (s^2 + 2 z w s + w^2),

m being -1 where the speed is the mass's, and the ratio of its inertia to the rotor's where it is
the rotor's.  For every w, and the dampings z of shafts, m is the largest of either sign up to 1
that keeps ``|D|`` below W.  A loop whose response with the motor G is y has the error

    E = D S Y / (1 + D T),

S being its sensitivity.

References
----------
.. [1] S. Skogestad, I. Postlethwaite, Multivariable Feedback Control, 2nd ed. (2005), sections 7.4
   to 7.6.
.. [2] G. Ellis, Control System Design Guide, 4th ed. (2012), chapter 16: resonances.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array, Complex
from smp_motor_ident.limits import (
    MAX_RESONANCE_DAMPING,
    RESONANCE_DAMPING,
    RESONANCE_ERROR,
    SETTLING_BAND,
    UNKNOWN_RESPONSE_ERROR,
)
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.plant import Plant
from smp_motor_ident.tune.simulation import find_last_exit, settling_time

FREQUENCY_COUNT = 40  # number of resonance frequencies, from the lowest of the bound up to Nyquist

DAMPINGS = np.geomspace(RESONANCE_DAMPING, MAX_RESONANCE_DAMPING, 4)
"""Damping ratios of resonances, spread over those of shafts."""

MIN_SAMPLES, MAX_SAMPLES = 2**13, 2**16
"""Simulated samples of a resonance, whose damping the feedback may reduce."""


@dataclass(frozen=True, eq=False)
class UnmodelledDynamics:
    """Bound on the relative error of the nominal motor's response."""

    frequency: Array  # shape (b,), [rad/s], rising
    bound: Array  # shape (b,), [-]

    def weight(self, omega: Array) -> Array:
        """Return the bound at some frequencies [rad/s]; nothing is known beyond the last."""
        right = UNKNOWN_RESPONSE_ERROR
        bound: Array = np.interp(np.log(omega), np.log(self.frequency), self.bound, right=right)
        return bound

    @property
    def known(self) -> float:
        """Frequency up to which the bound of the relative error is below 1 [rad/s]."""
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
    taken = np.minimum(bound, np.where(least > 0, RESONANCE_ERROR, UNKNOWN_RESPONSE_ERROR))
    taken = np.where(least > 1, RESONANCE_ERROR, taken)
    lowest = int(np.argmax(taken < 1))
    slower = (np.arange(taken.size) < lowest) & ~(least > 0)
    taken = np.where(slower, taken[lowest], taken)
    return UnmodelledDynamics(np.array(error.frequency), taken)


def describe_known_band(unmodelled: UnmodelledDynamics | None, before: str = "; ") -> str:
    """Return up to where the response is known, to be put behind other words."""
    if unmodelled is None or not math.isfinite(unmodelled.known):
        return ""
    return f"{before}the recording shows the motor's response up to {unmodelled.known:.3g} rad/s"


def compute_resonance_effect(
    unmodelled: UnmodelledDynamics | None, plant: Plant, feedback: Feedback, answer: Array
) -> tuple[float, float]:
    """Return the most that a resonance adds to overshoot and settling of a change of set-point.

    ``answer``, shape (k,), is the motor's without one, as a share of the change from rest.
    Returned are a share of the change, and a time [s]: NaN where it does not settle.
    """
    if unmodelled is None:
        return 0.0, 0.0
    T = plant.sample_time
    ringing = -math.log(SETTLING_BAND) / (RESONANCE_DAMPING * unmodelled.known * T)
    n = 2 ** math.ceil(math.log2(min(max(answer.size + ringing, MIN_SAMPLES), MAX_SAMPLES)))
    usual = np.pad(answer, (0, n - answer.size), mode="edge")
    time = T * np.arange(n, dtype=np.float64)
    omega = np.asarray(2 * np.pi * np.fft.rfftfreq(n, T)[1:], dtype=np.float64)
    complementary, moved = _close_loop(plant, feedback, omega, usual)
    settled, highest = settling_time(time, usual), usual.max()
    ends = [settled]
    for error in _largest_errors(unmodelled.frequency.tobytes(), unmodelled.bound.tobytes(), T, n):
        for D in (error, -error):
            spectrum = np.pad(D * moved / (1 + D * complementary), ((0, 0), (1, 0)))
            rows = usual + np.fft.irfft(spectrum, n)
            highest = max(highest, rows.max())
            ends.append(np.max(find_last_exit(time, np.abs(rows - 1.0) > SETTLING_BAND)))
    return float(highest - usual.max()), float(np.max(ends) - settled)


@functools.lru_cache(maxsize=4)
def _largest_errors(
    frequency: bytes, bound: bytes, sample_time: float, length: int
) -> list[Complex]:
    """Return the errors of the largest resonances, shape (frequency, omega), for each damping.

    They do not depend on the gains of a wheel, so the last ones are kept.
    """
    unmodelled = UnmodelledDynamics(np.frombuffer(frequency), np.frombuffer(bound))
    nyquist = math.pi / sample_time
    lowest = min(float(unmodelled.frequency[0]), 0.5 * nyquist)
    at = np.geomspace(lowest, 0.98 * nyquist, FREQUENCY_COUNT, dtype=np.float64)
    omega = np.asarray(2 * np.pi * np.fft.rfftfreq(length, sample_time)[1:], dtype=np.float64)
    return [
        compute_modes(omega, at, damping, sample_time)
        * find_largest_modes(unmodelled, at, damping, sample_time)[:, None]
        for damping in DAMPINGS
    ]


def compute_modes(omega: Array, at: Array, damping: float, sample_time: float) -> Complex:
    """Return ``s^2 / (s^2 + 2 z w s + w^2)`` over frequencies, a row for each w [rad/s].

    Sampled by Tustin's rule prewarped at w, so that it is causal.
    """
    ratio = np.tan(0.5 * omega * sample_time) / np.tan(0.5 * at * sample_time)[:, None]
    response: Complex = 1 / (1 - 1 / ratio**2 - 2j * damping / ratio)
    return response


def find_largest_modes(
    unmodelled: UnmodelledDynamics, at: Array, damping: float, sample_time: float
) -> Array:
    """Return the largest m, up to 1, for which modes stay within the bound."""
    ends = unmodelled.frequency[0], np.pi / sample_time
    omega = np.union1d(np.geomspace(*ends, 10 * FREQUENCY_COUNT), at)
    size = np.abs(compute_modes(omega, at, damping, sample_time))
    m: Array = np.minimum((unmodelled.weight(omega) / size).min(axis=1), 1.0)
    return m


def _close_loop(
    plant: Plant, feedback: Feedback, omega: Array, answer: Array
) -> tuple[Complex, Complex]:
    """Return T through the motor, and S Y: the response of the speed to an error."""
    z = np.exp(1j * omega * plant.sample_time)
    control = feedback.response(omega, plant.sample_time)
    response, through = plant.response(omega)[0], plant.through_motor(omega)[0]
    # An observer's prediction from the voltage closes no loop around the motor.
    own = 1 + control * (response - through)
    spectrum = np.fft.rfft(np.diff(answer, prepend=0.0))[1:] / (1 - 1 / z)
    whole = 1 + control * response
    return control * through / whole, own / whole * spectrum
