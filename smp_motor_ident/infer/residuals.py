# SPDX-License-Identifier: Apache-2.0
"""Tests of the residual: whiteness, independence of the voltage, error over frequency.

References
----------
L. Ljung, System Identification: Theory for the User, 2nd ed., section 16.6.
"""

from __future__ import annotations

import math
from itertools import pairwise
from statistics import NormalDist

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.fit.data import Data
from smp_motor_ident.fit.descend import Fit
from smp_motor_ident.infer.unmodelled import estimate_model_error
from smp_motor_ident.limits import RESIDUAL_LEVEL
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
    part = found.linear.output == 0
    rows = found.linear.row[part]
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
