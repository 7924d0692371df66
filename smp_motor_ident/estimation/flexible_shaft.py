r"""A motor that shows its encoder through a flexible shaft: one file, one candidate structure.

    w / v = K / ((tp s^2 + tau s + 1) (s^2 / w_r^2 + 2 zeta s / w_r + 1))

is what two inertias with a spring and a damper between them answer at the far one, whatever their
shares: from voltage and speed the resonance is known, the two inertias and the stiffness are not.
The zero of a damped shaft at ``-stiffness/damping`` is beyond the resonance; it shows as a little
less delay or L/R.

The response is exact for a voltage held over intervals of any length.  Gain, static voltage and
the state at the beginning of each segment enter linearly and are eliminated (variable
projection); residuals are whitened by an autoregression, so that angles under torque noise and
counts under quantisation are both weighed as they deserve.

References
----------
G. Golub and V. Pereyra, "Separable nonlinear least squares", Inverse Problems 19 (2003);
L. Ljung, *System Identification*, 2nd ed. (1999), section 7.4 for the whitened residuals.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtri

from smp_motor_control.arrays import Array, Complex
from smp_motor_ident._compile import compiled
from smp_motor_ident.diagnosis.limits import LOOSE_QUANTITY
from smp_motor_ident.errors import InsufficientExcitationError
from smp_motor_ident.estimation.simulation import simulate
from smp_motor_ident.likelihood.experiments import output_of
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.record import Record
from smp_motor_ident.result import NORMAL_95, UNITS, Candidate, Estimate, FitPercent, Quantity

NAME = "flexible_shaft"
NONLINEAR = (
    "time_constant",
    "time_constant_product",
    "resonance_frequency",
    "resonance_damping",
    "delay",
)
CHANCE = 1e-3
"""Size of the test that there is a resonance at all."""

AUTOREGRESSION = 16
"""Order of the whitening filter."""

FREQUENCIES = 60
"""Of the resonance that are tried, evenly on a logarithmic scale."""

REACH = 3.0
"""Natural logarithm of the factor by which a descent may leave its start."""

FEW = 8_000
"""Samples on which they are tried."""


@dataclass(frozen=True)
class _Segment:
    """One segment: instants, mean voltages, their friction's sign, and the output."""

    time: Array
    voltage: Array
    sign: Array
    output: Array
    angle: bool


def flexible_shaft(records: Sequence[Record], rigid: Estimate) -> Estimate:
    """Estimate a motor with a flexible shaft, from what a rigid one explains."""
    segments = [s for r in records for s in _segments(r, rigid)]
    tau, tp = rigid.value("time_constant"), rigid.value("time_constant_product")
    stiff = np.array([math.log(tau), math.log(max(tp, 1e-4 * tau * tau)), rigid.value("delay")])
    stiff, ar, _ = _fit(segments, [stiff], np.ones(1))
    theta, _, _ = _fit(segments, _starts(segments, stiff, ar), ar)
    for _ in range(2):
        ar = _whitener(segments, theta)
        theta, _, squares = _fit(segments, [theta], ar)
    _, _, rest = _fit(segments, [stiff], ar)
    gain = sum(s.time.size for s in segments) * math.log(rest / squares)
    least = chdtri(2, CHANCE / FREQUENCIES)  # any of the frequencies may be best by chance
    if gain < least:
        raise InsufficientExcitationError(
            f"{rigid.wheel}: no resonance of a flexible shaft is seen (deviance {gain:.1f} lower, "
            f"{least:.1f} wanted); record a chirp or square up to half the sampling "
            "rate, or use the model second_order"
        )
    names, values, covariance = _uncertainty(segments, theta, ar)
    return _estimate(rigid, segments, theta, (names, values, covariance), gain)


def _segments(record: Record, rigid: Estimate) -> list[_Segment]:
    output, kind, _ = output_of(record)
    _, speed = simulate(rigid, record)
    sign = np.sign(np.nan_to_num(speed))
    bounds = [*record.starts, len(record)]
    found = []
    for a, b in pairwise(bounds):
        time, y = record.time[a:b], output[a:b]
        there = np.isfinite(y)
        if there.sum() > 10 * AUTOREGRESSION:
            y = np.interp(time, time[there], y[there])
            found.append(_Segment(time, record.voltage[a:b], sign[a:b], y, kind == ANGLE))
    return found


def _poles(theta: Array) -> Complex:
    """Return the roots of the denominator; without a resonance of three parameters."""
    tau, tp = math.exp(theta[0]), math.exp(theta[1])
    poles = np.roots([tp, tau, 1.0]).astype(np.complex128)
    if theta.size == 3:
        return poles
    frequency, damping = math.exp(theta[2]), math.exp(theta[3])
    resonance = np.roots([1.0 / frequency**2, 2.0 * damping / frequency, 1.0])
    # A hair apart, so that the partial fractions exist.
    return np.concatenate((poles, resonance * (1.0 + 1e-7)))


@compiled
def _modes(poles: Complex, time: Array, voltage: Array) -> Complex:
    """Return the response of ``1 / (s - pole)`` to a held voltage, for every pole."""
    out = np.zeros((poles.size, time.size), dtype=np.complex128)
    for m in range(poles.size):
        pole, x, last = poles[m], 0.0 + 0.0j, -1.0
        grow, push = 1.0 + 0.0j, 0.0 + 0.0j
        for k in range(1, time.size):
            h = time[k] - time[k - 1]
            if abs(h - last) > 1e-9 * h:
                last = h
                grow = np.exp(pole * h)
                push = (grow - 1.0) / pole if pole != 0.0 else h + 0.0j
            x = grow * x + push * voltage[k]
            out[m, k] = x
    return out


def _columns(segment: _Segment, theta: Array) -> Array:
    """Return the responses to voltage and friction, then what the first state leaves."""
    poles, time = _poles(theta), segment.time
    if segment.angle:
        poles = np.append(poles, 0.0)
    scale = np.prod(-poles[poles != 0.0])
    weights = [scale / np.prod(np.delete(poles[m] - poles, m)) for m in range(poles.size)]
    late = max(float(theta[-1]), 0.0)
    rows = []
    for signal in (segment.voltage, -segment.sign):
        charge = np.concatenate(([0.0], np.cumsum(signal[1:] * np.diff(time))))
        moved = np.diff(np.interp(time - late, time, charge), prepend=0.0)
        held = moved / np.diff(time, prepend=time[0] - 1.0)
        rows.append((np.array(weights) @ _modes(poles, time, held)).real)
    since = time - time[0]
    for pole in poles[(poles.imag >= 0.0) & (poles != 0.0)]:
        decay = np.exp(pole * since)
        rows += [decay.real, decay.imag] if pole.imag > 0.0 else [decay.real]
    rows.append(np.ones(time.size))
    if segment.angle:
        rows.append(since)
    return np.array(rows)


def _design(segments: Sequence[_Segment], theta: Array, ar: Array) -> tuple[Array, Array]:
    """Return the whitened columns of all segments, each with its own state, and the outputs."""
    from scipy.signal import lfilter  # loaded only where a shaft is asked for

    blocks = [_columns(s, theta) for s in segments]
    own = [b.shape[0] - 2 for b in blocks]
    cut = ar.size - 1
    design = np.zeros((sum(b.shape[1] - cut for b in blocks), 2 + sum(own)))
    output, row, column = [], 0, 2
    for segment, block, free in zip(segments, blocks, own, strict=True):
        white = lfilter(ar, np.ones(1), block)[:, cut:]
        last = row + white.shape[1]
        design[row:last, :2] = white[:2].T
        design[row:last, column : column + free] = white[2:].T
        output.append(lfilter(ar, np.ones(1), segment.output)[cut:])
        row, column = last, column + free
    return design, np.concatenate(output)


def _solve(segments: Sequence[_Segment], theta: Array, ar: Array) -> tuple[Array, Array, Array]:
    """Return the linear parameters, the residuals, and the design."""
    design, output = _design(segments, theta, ar)
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0.0] = 1.0
    unit = design / scale
    linear = np.linalg.lstsq(unit.T @ unit, unit.T @ output, rcond=1e-13)[0] / scale
    return linear, output - design @ linear, design


def _fit(
    segments: Sequence[_Segment], starts: Sequence[Array], ar: Array
) -> tuple[Array, Array, float]:
    """Return the best of several descents, the whitening of its residuals, their squares."""
    from scipy.optimize import least_squares

    best, least = starts[0], math.inf
    step = float(np.median(np.diff(segments[0].time)))
    for start in starts:
        low, high = start - REACH, start + REACH
        low[-1], high[-1] = -1e-12, 20.0 * step
        found = least_squares(  # type: ignore[operator]  # the stubs have a module of its name
            lambda theta: _solve(segments, theta, ar)[1],
            np.clip(start, low, high),
            bounds=(low, high),
            x_scale=np.append(np.ones(start.size - 1), step),
            diff_step=1e-5,
            max_nfev=40,
        )
        if 2.0 * found.cost < least:
            best, least = found.x, 2.0 * found.cost
    return best, _whitener(segments, best), least


def _whitener(segments: Sequence[_Segment], theta: Array) -> Array:
    """Return the autoregression ``1, a1, ...`` of the residuals of a fit."""
    _, residual, _ = _solve(segments, theta, np.ones(1))
    p = AUTOREGRESSION
    lagged = np.array([residual[p - k : residual.size - k] for k in range(1, p + 1)])
    return np.concatenate(([1.0], -np.linalg.lstsq(lagged.T, residual[p:], rcond=1e-10)[0]))


def _starts(segments: Sequence[_Segment], stiff: Array, ar: Array) -> list[Array]:
    """Return the three likeliest resonances on a grid of frequencies."""
    first = segments[0]
    few = [replace(first, **{n: getattr(first, n)[:FEW] for n in ("time", "voltage", "sign",
                                                                  "output")})]  # fmt: skip
    highest = 0.95 * math.pi / float(np.median(np.diff(first.time)))
    lowest = min(2.0 * math.exp(-stiff[0]), 0.1 * highest)
    trials = []
    for frequency in np.geomspace(lowest, highest, FREQUENCIES):
        theta = np.array([stiff[0], stiff[1], math.log(frequency), math.log(0.05), stiff[2]])
        residual = _solve(few, theta, ar)[1]
        trials.append((float(residual @ residual), theta))
    return [theta for _, theta in sorted(trials, key=lambda trial: trial[0])[:3]]


def _uncertainty(
    segments: Sequence[_Segment], theta: Array, ar: Array
) -> tuple[tuple[str, ...], Array, Array]:
    """Return names, values and covariance of the combinations."""
    linear, residual, design = _solve(segments, theta, ar)
    steps = np.append(np.full(theta.size - 1, 1e-5), 1e-5 * math.exp(theta[0]))
    slopes = [
        (_design(segments, theta + step * unit, ar)[0] - design) @ linear / step
        for step, unit in zip(steps, np.eye(theta.size), strict=True)
    ]
    jacobian = np.column_stack((design, *slopes))
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    inverse = _inverse(jacobian / scale) / np.outer(scale, scale)
    count = design.shape[1]
    keep = [0, 1, *range(count, count + theta.size)]
    covariance = inverse[np.ix_(keep, keep)] * float(residual @ residual) / residual.size
    gain, share = linear[0], linear[1]
    values = np.array([gain, share / gain, *np.exp(theta[:-1]), max(theta[-1], 0.0)])
    turn = np.diag([1.0, 1.0 / gain, *np.exp(theta[:-1]), 1.0])
    turn[1, 0] = -share / gain**2
    names = ("dc_gain", "static_voltage", *NONLINEAR)
    return names, values, turn @ covariance @ turn.T


def _inverse(jacobian: Array) -> Array:
    """Return the inverse of a normal matrix; what the data do not show keeps a huge variance.

    A direction without effect is known to nothing, not, as a pseudo-inverse has it, exactly.
    """
    _, values, rows = np.linalg.svd(jacobian, full_matrices=False)
    least = float(values[0]) * max(jacobian.shape) * float(np.finfo(np.float64).eps)
    sizes = np.maximum(values, max(least, 1e-150))
    known: Array = rows.astype(np.float64) / sizes[:, None]
    return known.T @ known


def _quantity(name: str, value: float, spread: float, largest: float) -> Quantity:
    """Return value and interval, or that the data do not tell it."""
    size = {"static_voltage": largest, "delay": math.inf}.get(name, abs(value))
    if not spread < LOOSE_QUANTITY.value * size:
        return Quantity(None, None, None, UNITS[name], "unidentifiable")
    return Quantity(value, spread, (value - NORMAL_95 * spread, value + NORMAL_95 * spread),
                    UNITS[name])  # fmt: skip


def _estimate(
    rigid: Estimate,
    segments: Sequence[_Segment],
    theta: Array,
    found: tuple[tuple[str, ...], Array, Array],
    gain: float,
) -> Estimate:
    names, values, covariance = found
    spread = np.sqrt(np.diag(covariance))
    largest = max(float(np.abs(segment.voltage).max()) for segment in segments)
    combinations = {
        n: _quantity(n, float(v), float(d), largest)
        for n, v, d in zip(names, values, spread, strict=True)
    }
    keep = [k for k, n in enumerate(names) if combinations[n].value is not None]
    _, residual, _ = _solve(segments, theta, np.ones(1))
    percent = _speed_percent(segments, residual)
    return replace(
        rigid,
        model=NAME,
        parameters={},
        combinations=combinations,
        names=tuple(names[k] for k in keep),
        covariance=covariance[np.ix_(keep, keep)],
        fit_percent=FitPercent(percent, None),
        candidates=(
            *(replace(c, chosen=False) for c in rigid.candidates),
            Candidate(NAME, percent, None, True, f"deviance lower by {gain:.0f}"),
        ),
    )


def _speed_percent(segments: Sequence[_Segment], residual: Array) -> float:
    """Return the normalised fit of the speed, of angles differenced over a sample."""
    errors, speeds, begin = [], [], 0
    for s in segments:
        error, output = residual[begin : begin + s.time.size], s.output
        begin += s.time.size
        if s.angle:
            error, output = (np.diff(x) / np.diff(s.time) for x in (error, output))
        errors.append(error)
        speeds.append(output)
    speed = np.concatenate(speeds)
    rest = np.linalg.norm(np.concatenate(errors)) / np.linalg.norm(speed - speed.mean())
    return 100.0 * (1.0 - float(rest))
