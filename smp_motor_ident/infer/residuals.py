# SPDX-License-Identifier: Apache-2.0
r"""Tests of the residual: whiteness, independence of the voltage, error over frequency.

The error of the simulated output is regressed on the response to the voltage, band by band,

    E(j w) = D Y(j w) + V(j w),    D = sum E Y* / sum |Y|^2,

of the discrete Fourier transforms of segments under a Hann window.  ``Y`` is the simulated
response of the fitted motor without friction, or with it where that is smaller.  Friction turns
slow changes into kinks, which fill all frequencies and show no response to the voltage there.
``D`` is the relative error of the model's response, which is alike within a band.  Its
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

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from statistics import NormalDist
from typing import Any

import numpy as np

from smp_motor_control.arrays import Array, Complex, Integers
from smp_motor_ident.fit.data import Data
from smp_motor_ident.fit.descend import Fit
from smp_motor_ident.limits import (
    BAND_LEVEL,
    BAND_LINES,
    BAND_WIDTH,
    RESIDUAL_LEVEL,
    RESONANCE_DAMPING,
)
from smp_motor_ident.result import Correlation, ModelError, ResidualTests

MAX_LAG_ROWS = 25  # of correlations
MAX_ROWS = 200_000


def check_residuals(data: Data, found: Fit) -> ResidualTests:
    """Test the whitened residual of the motion for whiteness and independence of the voltage.

    With 95 % confidence all correlations at up to `MAX_LAG_ROWS` lags stay inside the band.
    """
    error = compute_model_error(data, found)
    e, band = _centre_residual(_place_whitened_residual(data, found))
    command = data.rows.mean_command
    u = (command - command.mean())[:MAX_ROWS]
    if e.std() == 0 or u.std() == 0:
        return ResidualTests(model_error=error)
    auto, own = _correlate_lags(e, e), _correlate_lags(u, u)
    # Two independent coloured signals correlate by chance with the sum of the product of their
    # autocorrelations (Ljung, equation 16.68).
    cross = _correlate_lags(e, u) / np.sqrt(auto[0] * own[0])
    auto, own = auto / auto[0], own / own[0]
    wide = band * math.sqrt(max(1.0, 1 + 2 * float((auto[1:] * own[1:]).sum())))
    lag = np.arange(MAX_LAG_ROWS + 1, dtype=np.float64)
    return ResidualTests(
        white=bool(np.abs(auto[1:]).max() < band),
        independent_of_input=bool(np.abs(cross).max() < wide),
        autocorrelation=Correlation(lag, auto, band),
        cross_correlation=Correlation(lag, cross, wide),
        model_error=error,
    )


def _place_whitened_residual(data: Data, found: Fit) -> Array:
    """Return the whitened residual of the motion, NaN where nothing was measured."""
    out = np.full(len(data), np.nan)
    part = found.linear.data.output == 0
    rows = found.linear.data.row[part]
    measured = np.isfinite(data.motion[rows])
    out[rows[measured]] = found.linear.residual[: part.size][part][measured]
    return out


def _centre_residual(error: Array) -> tuple[Array, float]:
    """Return errors without their mean, zero where missing or too few, and their band."""
    ok = np.isfinite(error)
    n = int(ok[:MAX_ROWS].sum())
    if n < 4 * MAX_LAG_ROWS:
        return np.zeros(MAX_LAG_ROWS + 1), np.inf
    e = np.where(ok, error - error[ok].mean(), 0.0)[:MAX_ROWS]
    return e, NormalDist().inv_cdf(1 - RESIDUAL_LEVEL / 2 / MAX_LAG_ROWS) / math.sqrt(n)


def _correlate_lags(a: Array, b: Array) -> Array:
    """Return the inner products of a and b, b delayed by 0 to `MAX_LAG_ROWS` rows."""
    n = min(len(a), len(b))
    return np.array([a[k:n] @ b[: n - k] for k in range(MAX_LAG_ROWS + 1)])


def compute_model_error(data: Data, found: Fit) -> ModelError | None:
    """Return the relative error of the simulated motion over frequency."""
    if data.known[0].size < 8:
        return None
    return estimate_model_error(
        data.rows.segment, data.motion - found.motion,
        [found.motion, _simulate_without_friction(data, found)], data.is_angle, data.rows.step,
    )  # fmt: skip


def _simulate_without_friction(data: Data, found: Fit) -> Array:
    """Return the response of the motor to the voltage alone."""
    from smp_motor_ident.chain.chain import respond

    still = {n: 0.0 for n in ("vc", "vc_reverse") if n in found.chain.values}
    values = {n: np.array([v]) for n, v in {**found.chain.values, **still}.items()}
    motion = respond(found.chain, values, data.rows, found.scales, found.initial).motion[:, 0]
    for a, b in pairwise(data.rows.segment):
        motion[a:b] -= motion[a]
    return np.asarray(motion)


HANN_LINES = 1 + 2 * (2 / 3) ** 2 + 2 * (1 / 6) ** 2
"""Lines under a Hann window that equal one independent line: neighbours correlate by 2/3, the next
by 1/6."""

ROUNDING_SHARE = 1e-14  # of a sum of squares

FIRST_LINE = 2  # the window spreads the mean over those below


def estimate_model_error(
    segment: Integers, error: Array, outputs: Sequence[Array], is_angle: bool, step: float
) -> ModelError | None:
    """Return the relative error of the model's response by bands of frequency, None without one.

    ``segment`` are the first rows of the segments, and the end.  ``error``, shape (n,), is measured
    less simulated output, NaN without a measurement; ``outputs``, of shape (n,) each, are the
    responses to the voltage with friction and without, ``step`` [s] is the interval of rows.
    """
    lines = [
        _compute_spectra(error[a:b], [one[a:b] for one in outputs], is_angle, step)
        for a, b in pairwise(segment)
        if np.isfinite(error[a:b]).sum() > 2 * BAND_LINES + FIRST_LINE
    ]
    if not lines:
        return None
    omega, of_error, *moved = (np.concatenate(x) for x in zip(*lines, strict=True))
    return compute_relative_error(omega, of_error, np.array(moved))


def _compute_spectra(
    error: Array, outputs: Sequence[Array], is_angle: bool, step: float
) -> tuple[Any, ...]:
    """Return frequencies, and the spectra of error and outputs of one segment."""
    known = np.flatnonzero(np.isfinite(error))
    if known.size < error.size:
        error = np.interp(np.arange(error.size), known, error[known])
    signals = np.array([error, *outputs])
    if is_angle:
        signals = np.diff(signals)
    window = np.hanning(signals.shape[1] + 2)[1:-1]
    spectra = np.fft.rfft(window * (signals - signals.mean(axis=1, keepdims=True)))[:, FIRST_LINE:]
    omega = (
        2 * np.pi * np.arange(FIRST_LINE, FIRST_LINE + spectra.shape[1]) / (signals.shape[1] * step)
    )
    return omega, *spectra


def compute_relative_error(omega: Array, error: Complex, output: Complex) -> ModelError | None:
    """Return the relative error of a response from lines of spectra, in any order.

    Of several outputs, rows of ``output``, each band takes the one that is moved least, but where
    another one shows more of an error than the response itself.
    """
    order = np.argsort(omega, kind="stable")
    omega, error, outputs = omega[order], error[order], np.atleast_2d(output)[:, order]
    found = []
    for a, b in _divide_into_bands(omega):
        moved = outputs[np.argsort(_sum_squares(outputs[:, a:b])), a:b]
        if moved[0].any():
            middle = float(np.sqrt(omega[a] * omega[b - 1]))
            filters = _list_trial_responses(omega[a:b])
            stated = [_find_surest_error(error[a:b], one * filters) for one in moved]
            most = max(stated, key=_compute_lower_limit)
            found.append((middle, *(most if _compute_lower_limit(most) > 1 else stated[0])))
    if not found:
        return None
    frequency, shown, radius = zip(*found, strict=True)
    return ModelError(frequency, shown, tuple(s + r for s, r in zip(shown, radius, strict=True)))


def _list_trial_responses(omega: Array) -> Complex:
    """Return trial responses of a band as rows: unity, and resonances."""
    span = float(np.log(omega[-1] / omega[0]))
    n = max(round(span / (2 * RESONANCE_DAMPING)), 1)
    at = omega[0] * np.exp(span * (np.arange(n)[:, None] + 0.5) / n)
    return np.vstack([np.ones(omega.size), _compute_resonance(omega, at)])


def _find_surest_error(error: Complex, outputs: Complex) -> tuple[float, float]:
    """Return size and radius of a band's error: of its mean, or of a resonance's peak."""
    n = len(outputs) - 1
    size, radius = _compute_error_circles(error, outputs, BAND_LEVEL / np.array([1, *[n] * n]))
    surely = size - radius
    most = 1 + int(np.argmax(surely[1:]))
    most = most if surely[most] > max(surely[0], 0.0) else 0
    return float(size[most]), float(radius[most])


def _compute_lower_limit(stated: tuple[float, float]) -> float:
    """Return the lower limit of an error from its size and radius."""
    return stated[0] - stated[1]


def _compute_error_circles(error: Complex, outputs: Complex, level: Array) -> tuple[Array, Array]:
    """Return the sizes of an error relative to outputs, one a row, and the radii of its circles."""
    power, m = _sum_squares(outputs), error.size / HANN_LINES
    size = np.abs(outputs.conj() @ error) / power
    # Residual of the projection, at least its rounding error
    whole = _sum_squares(error)
    rest = np.maximum(whole - size**2 * power, ROUNDING_SHARE * whole) / HANN_LINES / (m - 1)
    # Quantile of the F distribution with 2 and 2 (m - 1) degrees of freedom
    ratio = (m - 1) * (level ** (-1 / (m - 1)) - 1)
    return size, np.sqrt(ratio * rest * HANN_LINES / power)


def _sum_squares(rows: Complex) -> Array:
    """Return the sums of squares of rows."""
    parts = np.ascontiguousarray(rows).view(np.float64)
    return np.asarray(np.einsum("...i,...i->...", parts, parts))


def _compute_resonance(omega: Array, at: Array) -> Complex:
    """Return the response of a resonance, 1 at its peak."""
    width = 2j * RESONANCE_DAMPING * at * omega
    response: Complex = width / (at**2 - omega**2 + width)
    return response


def _divide_into_bands(omega: Array) -> Iterator[tuple[int, int]]:
    """Yield the first and the one after the last line of each band."""
    begin, least = 0, int(BAND_LINES)
    while begin + least <= omega.size:
        end = int(np.searchsorted(omega, omega[begin] * BAND_WIDTH))
        end = max(end, begin + least)
        if omega.size - end < least:
            end = omega.size
        yield begin, end
        begin = end
