r"""How far the motor's response may be from the model's, frequency by frequency.

The error of the simulated output is regressed on that output, band by band,

    E(j w) = D Y(j w) + V(j w),    D = sum E Y* / sum |Y|^2,

of the discrete Fourier transforms of segments under a Hann window: ``D`` is the relative error of
the model's response, which is alike within a band.  Its confidence region is a circle in the
complex plane of the radius

    r^2 = F_{2, 2(m-1)} s^2 / sum |Y|^2,    s^2 = sum |E - D Y|^2 / (m - 1),

with m the lines of the band, as many as are independent.  Where the voltage does not move the motor
the circle is wide.

References
----------
.. [1] L. Ljung, System Identification, 2nd ed., sections 6.4 and 16.6.
.. [2] W. Reinelt, A. Garulli, L. Ljung, Comparing different approaches to model error modeling in
   robust identification, Automatica 38 (2002), 787-803.
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from scipy.special import fdtri

from smp_motor_control.arrays import Array, Complex
from smp_motor_ident.diagnosis.response_limits import BAND_LEVEL, BAND_LINES, BAND_WIDTH
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.result import ModelError

HANN = 1 + 2 * (2 / 3) ** 2 + 2 * (1 / 6) ** 2
"""Lines under a Hann window that tell as much as one of independent ones: neighbours correlate by
2/3, the next by 1/6."""

FIRST = 2
"""Lines from 0 that the window fills with the mean."""


def unmodelled_dynamics(data: Experiments, fit: Fit) -> ModelError | None:
    """Return the relative error of the model's response over frequency, None where none is seen.

    Where nothing was measured, as between two edges of a count, the error is taken to run straight.
    """
    output = prediction.simulate(data, fit)[:, 1]
    error = data.output - output
    lines = [
        _spectra(data, error[a:b], output[a:b])
        for a, b in pairwise(data.starts)
        if np.isfinite(error[a:b]).sum() > 2 * BAND_LINES.value + FIRST
    ]
    if not lines:
        return None
    return relative_error(*map(np.concatenate, zip(*lines, strict=True)))


def _spectra(data: Experiments, error: Array, output: Array) -> tuple[Array, Complex, Complex]:
    """Return frequencies, and the spectra of error and output of one segment."""
    known = np.flatnonzero(np.isfinite(error))
    error = np.interp(np.arange(error.size), known, error[known])
    if data.kind == ANGLE:
        error, output = np.diff(error), np.diff(output)
    window = np.hanning(error.size + 2)[1:-1]
    of_error, of_output = (np.fft.rfft(window * (x - x.mean()))[FIRST:] for x in (error, output))
    omega = 2 * np.pi * np.arange(FIRST, FIRST + of_error.size) / (error.size * data.step)
    return omega.astype(np.float64), of_error, of_output


def relative_error(omega: Array, error: Complex, output: Complex) -> ModelError | None:
    """Return the relative error of a response from lines of spectra, in any order."""
    order = np.argsort(omega, kind="stable")
    omega, error, output = omega[order], error[order], output[order]
    found = []
    for a, b in _bands(omega):
        e, y = error[a:b], output[a:b]
        power, m = float(np.square(np.abs(y)).sum()), (b - a) / HANN
        if not power > 0:
            continue
        size = complex(np.sum(e * y.conj())) / power
        rest = float(np.square(np.abs(e - size * y)).sum()) / HANN / (m - 1)
        radius = np.sqrt(fdtri(2, 2 * (m - 1), 1 - BAND_LEVEL.value) * rest * HANN / power)
        found.append((float(np.sqrt(omega[a] * omega[b - 1])), abs(size), float(radius)))
    if not found:
        return None
    frequency, shown, radius = zip(*found, strict=True)
    return ModelError(frequency, shown, tuple(s + r for s, r in zip(shown, radius, strict=True)))


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
