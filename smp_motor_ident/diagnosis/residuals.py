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

MOST = 200_000  # samples; the band then is a fiftieth of a percent


def residual_tests(data: Experiments, fit: Fit, lags: int = 25) -> ResidualTests:
    """Test the innovations for whiteness and for independence from the input.

    Autocorrelations (cross-correlations with the voltage) at up to ``lags`` lags stay, with
    95 % confidence for all of them together, inside the band.

    References
    ----------
    L. Ljung, *System Identification: Theory for the User*, 2nd ed., section 16.6.
    """
    residual = data.output - prediction.simulate(data, fit, gain=True)[:, 1]
    voltage = voltage_at_samples(data)
    ok = np.isfinite(residual)
    e = np.where(ok, residual - residual[ok].mean(), 0.0)[:MOST]
    u = (voltage - voltage.mean())[:MOST]
    n = int(ok[:MOST].sum())
    if n < 4 * lags or e.std() == 0 or u.std() == 0:
        return ResidualTests(model_error=unmodelled_dynamics(data, fit))
    band = float(ndtri(1 - RESIDUAL_LEVEL.value / 2 / lags) / np.sqrt(n))
    auto = _lagged(e, e, lags)
    own = _lagged(u, u, lags)
    # Two independent coloured signals correlate by chance with the sum of the product of their
    # autocorrelations (Ljung, equation 16.68).
    cross = _lagged(e, u, lags) / np.sqrt(auto[0] * own[0])
    auto, own = auto / auto[0], own / own[0]
    wide = band * float(np.sqrt(max(1.0, 1 + 2 * float((auto[1:] * own[1:]).sum()))))
    lag = np.arange(lags + 1, dtype=np.float64)
    return ResidualTests(
        white=bool(np.abs(auto[1:]).max() < band),
        independent_of_input=bool(np.abs(cross).max() < wide),
        autocorrelation=Correlation(lag, auto, band),
        cross_correlation=Correlation(lag, cross, wide),
        model_error=unmodelled_dynamics(data, fit),
    )


def coloured(error: Array, lags: int = 25) -> bool:
    """Tell whether neighbouring errors hang together, by the same band; errors may be NaN."""
    ok = np.isfinite(error)
    e = np.where(ok, error - error[ok].mean(), 0.0)[:MOST] if ok.any() else np.zeros(0)
    n = int(ok[:MOST].sum())
    if n < 4 * lags or e.std() == 0:
        return False
    auto = _lagged(e, e, lags)
    band = float(ndtri(1 - RESIDUAL_LEVEL.value / 2 / lags) / np.sqrt(n))
    return bool(np.abs(auto[1:]).max() >= band * auto[0])


def voltage_at_samples(data: Experiments) -> Array:
    """Return the voltage at the samples' instants, segment by segment."""
    if data.plain:
        return data.hold_value
    out = np.empty(data.size)
    for g, (a, b) in enumerate(zip(data.starts[:-1], data.starts[1:])):
        first = int(data.hold_start[g])
        last = int(data.hold_start[g + 1]) if g + 2 < len(data.starts) else len(data.hold_end)
        at = np.searchsorted(data.hold_end[first:last], data.time[a:b])
        out[a:b] = data.hold_value[first + np.minimum(at, last - first - 1)]
    return out


def _lagged(a: Array, b: Array, lags: int) -> Array:
    """Return the inner products of a and b, b delayed by 0 to ``lags`` samples."""
    n = len(a)
    return np.array([np.einsum("i,i->", a[k:], b[: n - k]) for k in range(lags + 1)])
