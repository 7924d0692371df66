r"""How far the motor's response may be from the model's, frequency by frequency.

The error of the simulated output is regressed on what the voltage moves, band by band,

    E(j w) = D Y(j w) + V(j w),    D = sum E Y* / sum |Y|^2,

of the discrete Fourier transforms of segments under a Hann window.  ``Y`` is the output that the
voltage moves: of the fitted motor without friction, or with it where that moves less.  The kinks
that friction makes of slow changes fill all frequencies, and tell nothing of what a voltage does
there.  ``D`` is the relative error of the model's response, which is alike within a band.  Its
confidence region is a circle in the complex plane of the radius

    r^2 = F_{2, 2(m-1)} s^2 / sum |Y|^2,    s^2 = sum |E - D Y|^2 / (m - 1),

with m the lines of the band, as many as are independent.  Where the voltage does not move the motor
the circle is wide.

A resonance narrower than its band, whose phase turns by 180 degrees, leaves little of itself in
that mean.  The same regression on the output behind a resonance of peak 1,

    M(j w) = 2 j z w w_r / (w_r^2 - w^2 + 2 j z w w_r),

finds its peak (a matched filter), for each w_r of the band that differs by a resonance's width.  Of
mean and peaks, the one that is shown with the largest lower limit is stated.

References
----------
.. [1] L. Ljung, System Identification, 2nd ed., sections 6.4 and 16.6.
.. [2] W. Reinelt, A. Garulli, L. Ljung, Comparing different approaches to model error modeling in
   robust identification, Automatica 38 (2002), 787-803.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import fdtri

from smp_motor_control.arrays import Array, Complex
from smp_motor_ident.diagnosis.response_limits import (
    BAND_LEVEL,
    BAND_LINES,
    BAND_WIDTH,
    RESONANCE_DAMPING,
)
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.result import ModelError

HANN = 1 + 2 * (2 / 3) ** 2 + 2 * (1 / 6) ** 2
"""Lines under a Hann window that tell as much as one of independent ones: neighbours correlate by
2/3, the next by 1/6."""

ROUNDING = 1e-14
"""Share of a sum of squares that rounding leaves."""

FIRST = 2
"""Lines from 0 that the window fills with the mean."""


def unmodelled_dynamics(data: Experiments, fit: Fit) -> ModelError | None:
    """Return the relative error of the model's response over frequency, None where none is seen.

    Where nothing was measured, as between two edges of a count, the error is taken to run straight.
    """
    output = prediction.simulate(data, fit)[:, 1]
    error, outputs = data.output - output, [output]
    if fit.z.vc_plus or fit.z.vc_minus:
        outputs.append(_without_friction(data, fit))
    lines = [
        _spectra(data, error[a:b], *(one[a:b] for one in outputs))
        for a, b in pairwise(data.starts)
        if np.isfinite(error[a:b]).sum() > 2 * BAND_LINES.value + FIRST
    ]
    if not lines:
        return None
    omega, of_error, *moved = (np.concatenate(x) for x in zip(*lines, strict=True))
    return relative_error(omega, of_error, np.array(moved))


def _without_friction(data: Experiments, fit: Fit) -> Array:
    """Return the output of a fitted motor that nothing but the voltage moves."""
    z = fit.z.with_(vc_plus=0.0, vc_minus=0.0)
    return prediction.once(data, replace(fit, z=z))[:, 1]


def _spectra(data: Experiments, error: Array, *outputs: Array) -> tuple[Any, ...]:
    """Return frequencies, and the spectra of error and outputs of one segment."""
    known = np.flatnonzero(np.isfinite(error))
    if known.size < error.size:
        error = np.interp(np.arange(error.size), known, error[known])
    signals = np.array([error, *outputs])
    if data.kind == ANGLE:
        signals = np.diff(signals)
    window = np.hanning(signals.shape[1] + 2)[1:-1]
    spectra = np.fft.rfft(window * (signals - signals.mean(axis=1, keepdims=True)))[:, FIRST:]
    omega = 2 * np.pi * np.arange(FIRST, FIRST + spectra.shape[1]) / (signals.shape[1] * data.step)
    return omega, *spectra


def relative_error(omega: Array, error: Complex, output: Complex) -> ModelError | None:
    """Return the relative error of a response from lines of spectra, in any order.

    Of several outputs, rows of ``output``, each band takes the one that is moved least, but where
    another one shows more of an error than the response itself.
    """
    order = np.argsort(omega, kind="stable")
    omega, error, outputs = omega[order], error[order], np.atleast_2d(output)[:, order]
    found = []
    for a, b in _bands(omega):
        moved = outputs[np.argsort(_power(outputs[:, a:b])), a:b]
        if moved[0].any():
            middle = float(np.sqrt(omega[a] * omega[b - 1]))
            filters = _filters(omega[a:b])
            stated = [_most_shown(error[a:b], one * filters) for one in moved]
            most = max(stated, key=_surely)
            found.append((middle, *(most if _surely(most) > 1 else stated[0])))
    if not found:
        return None
    frequency, shown, radius = zip(*found, strict=True)
    return ModelError(frequency, shown, tuple(s + r for s, r in zip(shown, radius, strict=True)))


def _filters(omega: Array) -> Complex:
    """Return what the output of a band may be behind, rows: nothing, and resonances."""
    span = float(np.log(omega[-1] / omega[0]))
    n = max(round(span / (2 * RESONANCE_DAMPING.value)), 1)
    at = omega[0] * np.exp(span * (np.arange(n)[:, None] + 0.5) / n)
    return np.vstack([np.ones(omega.size), _resonance(omega, at)])


def _most_shown(error: Complex, outputs: Complex) -> tuple[float, float]:
    """Return size and radius of a band's error: of its mean, or of a resonance's peak."""
    n = len(outputs) - 1
    size, radius = _circles(error, outputs, BAND_LEVEL.value / np.array([1, *[n] * n]))
    surely = size - radius
    most = 1 + int(np.argmax(surely[1:]))
    most = most if surely[most] > max(surely[0], 0.0) else 0
    return float(size[most]), float(radius[most])


def _surely(stated: tuple[float, float]) -> float:
    """Return the lower limit of an error from its size and radius."""
    return stated[0] - stated[1]


def _circles(error: Complex, outputs: Complex, level: Array) -> tuple[Array, Array]:
    """Return the sizes of an error relative to outputs, one a row, and the radii of its circles."""
    power, m = _power(outputs), error.size / HANN
    size = np.abs(outputs.conj() @ error) / power
    # What a projection leaves of an error; none of less than its rounding is known.
    whole = _power(error)
    rest = np.maximum(whole - size**2 * power, ROUNDING * whole) / HANN / (m - 1)
    return size, np.sqrt(fdtri(2, 2 * (m - 1), 1 - level) * rest * HANN / power)


def _power(rows: Complex) -> Array:
    """Return the sums of squares of rows."""
    parts = np.ascontiguousarray(rows).view(np.float64)
    return np.asarray(np.einsum("...i,...i->...", parts, parts))


def _resonance(omega: Array, at: Array) -> Complex:
    """Return the response of a resonance, 1 at its peak."""
    width = 2j * RESONANCE_DAMPING.value * at * omega
    response: Complex = width / (at**2 - omega**2 + width)
    return response


def _bands(omega: Array) -> Iterator[tuple[int, int]]:
    """Yield the first and the one after the last line of each band."""
    begin, least = 0, int(BAND_LINES.value)
    while begin + least <= omega.size:
        end = int(np.searchsorted(omega, omega[begin] * BAND_WIDTH.value))
        end = max(end, begin + least)
        if omega.size - end < least:
            end = omega.size
        yield begin, end
        begin = end
