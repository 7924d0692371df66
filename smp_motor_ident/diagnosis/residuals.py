"""Correlation of the innovations with themselves and with the voltage: the verdict and its curves.

The report draws what this returns, so that the picture and the verdict are of one residual
under one band.
"""

import numpy as np
from scipy.special import ndtri

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import RESIDUAL_LEVEL
from smp_motor_ident.diagnosis.unmodelled import unmodelled_dynamics
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.result import Correlation, ResidualTests

LAGS = 25  # samples up to which correlations are looked at
MOST = 200_000  # samples; the band then is a fiftieth of a percent


def residual_tests(data: Experiments, fit: Fit) -> ResidualTests:
    """Test the innovations for whiteness and for independence from the input.

    Autocorrelations (cross-correlations with the voltage) at up to :data:`LAGS` lags stay, with
    95 % confidence for all of them together, inside the band.

    References
    ----------
    L. Ljung, *System Identification: Theory for the User*, 2nd ed., section 16.6.
    """
    residual = data.output - prediction.simulate(data, fit, gain=True)[:, 1]
    voltage = prediction.voltage_at_samples(data)
    e, band = _centred(residual)
    u = (voltage - voltage.mean())[:MOST]
    if e.std() == 0 or u.std() == 0:
        return ResidualTests(model_error=unmodelled_dynamics(data, fit))
    auto, own = _lagged(e, e), _lagged(u, u)
    # Two independent coloured signals correlate by chance with the sum of the product of their
    # autocorrelations (Ljung, equation 16.68).
    cross = _lagged(e, u) / np.sqrt(auto[0] * own[0])
    auto, own = auto / auto[0], own / own[0]
    wide = band * float(np.sqrt(max(1.0, 1 + 2 * float((auto[1:] * own[1:]).sum()))))
    lag = np.arange(LAGS + 1, dtype=np.float64)
    return ResidualTests(
        white=bool(np.abs(auto[1:]).max() < band),
        independent_of_input=bool(np.abs(cross).max() < wide),
        autocorrelation=Correlation(lag, auto, band),
        cross_correlation=Correlation(lag, cross, wide),
        model_error=unmodelled_dynamics(data, fit),
    )


def coloured(error: Array) -> bool:
    """Tell whether neighbouring errors hang together, by the same band; errors may be NaN."""
    e, band = _centred(error)
    auto = _lagged(e, e)
    return bool(auto[0] > 0 and np.abs(auto[1:]).max() >= band * auto[0])


def _centred(error: Array) -> tuple[Array, float]:
    """Return errors without their mean, nothing where there is none or few are, and their band."""
    ok = np.isfinite(error)
    n = int(ok[:MOST].sum())
    if n < 4 * LAGS:
        return np.zeros(LAGS + 1), np.inf
    e = np.where(ok, error - error[ok].mean(), 0.0)[:MOST]
    return e, float(ndtri(1 - RESIDUAL_LEVEL.value / 2 / LAGS) / np.sqrt(n))


def _lagged(a: Array, b: Array) -> Array:
    """Return the inner products of a and b, b delayed by 0 to :data:`LAGS` samples."""
    n = len(a)
    return np.array([np.einsum("i,i->", a[k:], b[: n - k]) for k in range(LAGS + 1)])
