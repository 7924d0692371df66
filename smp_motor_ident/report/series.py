"""What a figure needs beside the estimate: measured and simulated speed, and their difference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Role = Literal["estimation", "validation"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured against simulated motor speed over one stretch of data.

    Attributes
    ----------
    role : {'estimation', 'validation'}
        Whether the model was fitted to this stretch or only judged by it.
    source : str
        Name of the bag.
    time : ndarray, shape (n,), [s]
        From the stretch's start.
    voltage, measured, simulated : ndarray, shape (n,), [V, rad/s, rad/s]
        At the motor shaft; NaN where nothing was measured.
    """

    role: Role
    source: str
    time: Array
    voltage: Array
    measured: Array
    simulated: Array

    @property
    def residual(self) -> Array:
        """Measured minus simulated speed [rad/s]."""
        return self.measured - self.simulated


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation of residuals over lags, with the band that chance stays in 95 % of the time."""

    lag: Array
    value: Array
    band: float


def correlations(parts: Sequence[Comparison], lags: int = 40) -> tuple[Correlation, Correlation]:
    """Correlate the residuals with themselves and with the input.

    References
    ----------
    L. Ljung, *System Identification: Theory for the User*, 2nd ed., section 16.6.
    """
    auto: Array = np.zeros(2 * lags + 1)
    cross: Array = np.zeros(2 * lags + 1)
    scale: Array = np.zeros(2 * lags + 1)
    used, energy_u, energy_e = 0, 0.0, 0.0
    for part in parts:
        residual = np.nan_to_num(part.residual - np.nanmean(part.residual))
        voltage = part.voltage - part.voltage.mean()
        if residual.size <= 2 * lags:
            continue
        auto += _lagged(residual, residual, lags)
        cross += _lagged(residual, voltage, lags)
        scale += _lagged(voltage, voltage, lags)
        energy_e, energy_u = energy_e + residual @ residual, energy_u + voltage @ voltage
        used += residual.size
    if used == 0 or energy_e == 0.0 or energy_u == 0.0:
        nothing = Correlation(np.zeros(0), np.zeros(0), 0.0)
        return nothing, nothing
    lag = np.arange(-lags, lags + 1, dtype=np.float64)
    white = 1.96 / np.sqrt(used)
    auto, cross, scale = auto / energy_e, cross / np.sqrt(energy_e * energy_u), scale / energy_u
    # The cross-correlation of two independent coloured signals scatters with the sum of the
    # product of their autocorrelations (Ljung, equation 16.68).
    spread = np.sqrt(max(float(auto @ scale), 1.0) / used)
    return (
        Correlation(lag[lags:], auto[lags:], float(white)),
        Correlation(lag, cross, 1.96 * float(spread)),
    )


def _lagged(late: Array, early: Array, lags: int) -> Array:
    """Sums of ``late[k] early[k - lag]`` for lags from -lags to lags, by FFT."""
    size = int(2 ** np.ceil(np.log2(late.size + 2 * lags + 1)))
    product = np.fft.irfft(np.fft.rfft(late, size) * np.conj(np.fft.rfft(early, size)), size)
    return np.concatenate((product[-lags:], product[: lags + 1]))


def thin(time: Array, values: Array, points: int = 1600) -> tuple[Array, Array]:
    """Keep the smallest and largest value of each of ``points / 2`` stretches."""
    if values.size <= points:
        return time, values
    size = -(-values.size // (points // 2))
    full = values[: values.size - values.size % size].reshape(-1, size)
    whole = np.where(np.isfinite(full), full, np.nanmean(values))
    begin = np.arange(full.shape[0]) * size
    index = np.concatenate((begin + whole.argmin(axis=1), begin + whole.argmax(axis=1)))
    index = np.unique(np.concatenate((index, [0, values.size - 1])))
    return time[index], values[index]
