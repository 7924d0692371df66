# SPDX-License-Identifier: Apache-2.0
"""Make the charts of one motor: fit, residual correlations, frequency response."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.report.drawing import Chart, Curve, thin
from smp_motor_ident.report.words import label
from smp_motor_ident.result import ResidualTests

MAX_POINTS = 8000  # points of a curve over time: one a pixel when zoomed in tenfold
VIEW_LAGS = 80.0  # time constants that a screen shows at first: single responses are visible
MIN_COHERENCE = 0.6
"""Smallest coherence of a shown frequency; below it most of the spectrum is no response."""

MAX_MISSING_INTERVALS = 20.0  # missing intervals after which a new spectrum begins

Role = Literal["estimation", "validation"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured against simulated motor speed over one stretch of data."""

    role: Role  # whether the model was fitted to this stretch
    source: str  # name of the bag
    time: Array  # shape (n,), [s]: from the stretch's start
    # voltage, measured, simulated: shape (n,), [V, rad/s, rad/s]: at the motor shaft; NaN where
    # nothing was measured
    voltage: Array
    measured: Array
    simulated: Array


def fit_charts(wheel: str, parts: Sequence[Comparison], lag: float = 0.0) -> list[Chart]:
    """Return speed, residual and voltage over all stretches; the view begins at the liveliest."""
    ends = np.cumsum([0.0, *(float(part.time[-1]) for part in parts)]).tolist()
    spans = [(*span, part.role) for span, part in zip(pairwise(ends), parts)]
    time = np.concatenate([begin + part.time for begin, part in zip(ends, parts)])
    measured = np.concatenate([part.measured for part in parts])
    simulated = np.concatenate([part.simulated for part in parts])
    voltage = np.concatenate([part.voltage for part in parts])
    keep = np.union1d(thin(measured, MAX_POINTS // 2), thin(simulated, MAX_POINTS // 2))
    name, view = label(wheel), _find_liveliest(time, measured, spans, VIEW_LAGS * lag)

    def chart(kind: str, y_label: str, height: int, *curves: Curve) -> Chart:
        return Chart(
            name=f"{kind}-{wheel}", title=f"{name}: {kind}", x_label="time [s]", y_label=y_label,
            x=time[keep], curves=curves, spans=tuple(spans), group=wheel, height=height,
            view=view, summary=f"{kind.capitalize()} of {name} over {time[-1]:.1f} s.",
        )  # fmt: skip

    speeds = (
        Curve("measured", measured[keep], "measured", width=3.5),  # seen behind the simulated one
        Curve("simulated", simulated[keep], "simulated"),
    )
    residual = Curve("measured − simulated", (measured - simulated)[keep], "ink")
    return [
        chart("speed", "motor speed [rad/s]", 300, *speeds),
        chart("residual", "residual [rad/s]", 180, residual),
        chart("voltage", "voltage [V]", 180, Curve("voltage", voltage[keep], "voltage")),
    ]


def _find_liveliest(
    time: Array, speed: Array, spans: Sequence[tuple[float, float, Role]], length: float
) -> tuple[float, float] | None:
    """Return the stretch of held-out data, else of any, in which the speed scatters most."""
    begin, end, _ = max(spans, key=lambda span: (span[2] == "validation", span[1] - span[0]))
    if not 0.0 < length < end - begin:
        return None
    starts = np.arange(begin, end - 0.99 * length, length)
    inside = [speed[(time >= first) & (time < first + length)] for first in starts]
    spread = [float(np.nanstd(part)) if np.isfinite(part).any() else 0.0 for part in inside]
    first = float(starts[int(np.argmax(spread))])
    return first, first + length


def residual_charts(wheel: str, tests: ResidualTests) -> list[Chart]:
    """Return the correlations of the residual tests, with their bands."""
    charts = []
    for kind, found in (
        ("autocorrelation", tests.autocorrelation),
        ("correlation with the voltage", tests.cross_correlation),
    ):
        if found is None:
            continue
        lag, value = found.lag, found.value
        if kind == "autocorrelation":  # at lag 0 it is 1 by definition
            lag, value = lag[lag > 0], value[lag > 0]
        outside = np.abs(value) > found.band
        within, beyond = (np.where(which, value, np.nan) for which in (~outside, outside))
        curves = (
            Curve("within the band", within, "good", "bars"),
            Curve("outside", beyond, "bad", "bars"),
        )
        charts.append(Chart(
            name=f"{kind.split()[0]}-{wheel}", title=f"Residual {kind}",
            x_label="lag [samples]", y_label="correlation", x=lag, curves=curves,
            lines=(-found.band, 0.0, found.band),
            summary=f"{np.sum(outside)} of {lag.size} lags lie outside ±{found.band:.3g}.",
        ))  # fmt: skip
    return charts


def frequency_charts(wheel: str, parts: Sequence[Comparison]) -> list[Chart]:
    """Return gain and phase from voltage to speed, of the data and of the model.

    Both are estimated in the same way from the same voltage, so friction, hold and sampling affect
    both alike.  A difference beyond the band shows an effect that the model lacks.
    """
    found = _estimate_response(parts)
    if found is None:
        return []
    frequency, measured, simulated, spread = found
    name = label(wheel)
    charts = []
    for kind, unit, of, low, high in (
        ("gain", "rad/s/V", np.abs, np.exp(-spread), np.exp(spread)),
        ("phase", "deg", lambda response: np.rad2deg(np.unwrap(np.angle(response))),
         -np.rad2deg(spread), np.rad2deg(spread)),
    ):  # fmt: skip
        y = of(measured)
        around = (y * low, y * high) if kind == "gain" else (y + low, y + high)
        curves = (
            Curve("data, 95 % band", y, "measured", "points", *around),
            Curve("model", of(simulated), "simulated"),
        )
        span = f"from {frequency[0]:.2g} to {frequency[-1]:.3g} Hz"
        charts.append(Chart(
            name=f"{kind}-{wheel}", title=f"Frequency response: {kind}", x_label="frequency [Hz]",
            y_label=f"{kind} [{unit}]", x=frequency, curves=curves,
            log="xy" if kind == "gain" else "x", group=f"frequency-{wheel}",
            summary=f"{kind.capitalize()} of {name} {span}.",
        ))  # fmt: skip
    return charts


def _split_at_pauses(part: Comparison, step: float) -> list[tuple[Array, ...]]:
    """Return time, voltage, measured and simulated speed of the pieces between pauses."""
    known = np.isfinite(part.measured) & np.isfinite(part.simulated)
    whole = (part.time, part.voltage, part.measured, part.simulated)
    columns = [column[known] for column in whole]
    begins = np.flatnonzero(np.diff(columns[0]) > MAX_MISSING_INTERVALS * step) + 1
    return [*zip(*(np.split(column, begins) for column in columns))] if known.any() else []


def _estimate_response(parts: Sequence[Comparison]) -> tuple[Array, Array, Array, Array] | None:
    """Return frequencies, responses of data and model, and the 95 % band of the log of the data's.

    References
    ----------
    J. S. Bendat, A. G. Piersol, *Random Data*, 4th ed., section 9.2.4: the relative deviation of
    a response with coherence g over n averages is ``sqrt((1 - g) / (2 n g))``.
    """
    step = float(np.median(np.diff(max(parts, key=lambda part: part.time.size).time)))
    pieces = [piece for part in parts for piece in _split_at_pauses(part, step)]
    longest = max((time.size for time, *_ in pieces), default=0)
    size = int(2 ** np.floor(np.log2(max(longest / 4, 1))))
    if size < 64 or step <= 0:
        return None
    window = np.hanning(size)
    sums = np.zeros((4, size // 2 + 1), dtype=np.complex128)
    averages = 0
    for time, *columns in pieces:
        even = np.arange(time[0], time[-1], step)
        signals = [np.interp(even, time, y) for y in columns]
        for first in range(0, even.size - size + 1, size // 2):
            cut = [s[first : first + size] for s in signals]
            u, y, z = (np.fft.rfft(window * (c - c.mean())) for c in cut)
            sums += np.array([u * u.conj(), y * y.conj(), y * u.conj(), z * u.conj()])
            averages += 1
    power, own = sums[0].real, sums[1].real
    with np.errstate(invalid="ignore", divide="ignore"):
        coherence = np.abs(sums[2]) ** 2 / (power * own)
        usable = (coherence > MIN_COHERENCE) & (power > 1e-6 * power.max())
    usable[0] = False
    usable[size // 4 :] = False  # above half the Nyquist frequency the hold shapes both
    index = np.flatnonzero(usable)
    if averages < 3 or index.size < 5:
        return None
    coherence = np.minimum(coherence[index], 1 - 1e-12)
    # Half of the overlapping segments count as independent averages.
    spread = 1.96 * np.sqrt((1 - coherence) / (averages * coherence))
    measured, simulated = sums[2][index] / power[index], sums[3][index] / power[index]
    return index / (size * step), measured, simulated, spread
