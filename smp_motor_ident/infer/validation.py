# SPDX-License-Identifier: Apache-2.0
"""Share of the motion that a chain explains, in fitted and in held-out data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.chain.catalogue import rebuild_chain
from smp_motor_ident.chain.chain import Chain
from smp_motor_ident.chain.component import Scales
from smp_motor_ident.chain.motor import Load
from smp_motor_ident.chain.sensor import Angle, Speed
from smp_motor_ident.fit.data import Data, prepare
from smp_motor_ident.fit.descend import Fit, descend, simulate_freely
from smp_motor_ident.fit.noise import Noise
from smp_motor_ident.fit.start import hold_last_value
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate, FitPercent

MAX_COARSE_NOISE_SHARE = 0.02  # of the speed's scatter, by the rounding of an angle
FITTED_SHARE = 0.7
MIN_PART_ROWS = 25


def compute_fit_percent(measured: Array, predicted: Array, scatter: float = 0.0) -> float:
    """Return the normalised fit ``100 (1 - |y - yhat| / |y - mean y|)``, NaN if undefined.

    With ``scatter`` [rad/s] the root mean square of the error is compared with that instead.
    """
    ok = np.isfinite(measured) & np.isfinite(predicted)
    y, z = measured[ok], predicted[ok]
    scatter = scatter or (float(y.std()) if y.size else 0.0)
    if scatter == 0.0 or not y.size:
        return float("nan")
    return float(100 * (1 - np.sqrt(np.square(y - z).mean()) / scatter))


def compare_speeds(data: Data, simulated: Array) -> tuple[Array, Array]:
    """Return measured and simulated speed [rad/s] of a simulated motion.

    Of an angle both are means over so many rows that its resolution adds little.
    """
    if not data.is_angle:
        return data.motion, simulated
    time, motion = data.rows.time, hold_last_value(data.motion, data.rows.segment)
    lag = 1
    noise = np.sqrt(2) * max(data.quantum / np.sqrt(12), _estimate_white_std(motion))
    scatter = float(np.nanstd(_difference_angle(time, data.rows.segment, simulated, 1)))
    while noise / (lag * data.rows.step) > MAX_COARSE_NOISE_SHARE * scatter and 8 * lag < time.size:
        longer = _difference_angle(time, data.rows.segment, simulated, 2 * lag)
        if np.isnan(longer).all() or np.nanstd(longer) < 0.7 * scatter:
            break
        lag *= 2
    return (
        _difference_angle(time, data.rows.segment, motion, lag),
        _difference_angle(time, data.rows.segment, simulated, lag),
    )


def _estimate_white_std(angle: Array) -> float:
    """Return the standard deviation of the white part of an angle, by fourth differences."""
    y = angle[np.isfinite(angle)]
    return float(np.std(np.diff(y, n=4)) / np.sqrt(70)) if y.size > 8 else 0.0


def estimate_white_share(data: Data) -> float:
    """Return the share of white noise in the scatter of the motion."""
    scatter = float(np.nanstd(data.motion))
    return _estimate_white_std(data.motion) / scatter if scatter > 0 else 1.0


def _difference_angle(time: Array, segment: Integers, angle: Array, lag: int) -> Array:
    speed = np.full(time.size, np.nan)
    speed[lag:] = (angle[lag:] - angle[:-lag]) / (time[lag:] - time[:-lag])
    for first in segment[:-1]:
        speed[first : first + lag] = np.nan
    return speed


def compute_explained_percent(data: Data, simulated: Array) -> float:
    """Return the fit percent of the speed without its white noise."""
    measured, predicted = compare_speeds(data, simulated)
    error = (measured - predicted)[np.isfinite(measured - predicted)]
    white = _estimate_white_std(error) ** 2
    moved = float(np.nanvar(measured)) - white
    left = max(float(np.square(error).mean()) - white, 0.0)
    return 100 * (1 - float(np.sqrt(left / moved))) if moved > 0 else 0.0


def compute_fit_percents(
    group: Sequence[Record], data: Data, found: Fit, held_out: Sequence[Record] | None
) -> FitPercent:
    """Return the fit of the data, and of records or a last part that were held out."""
    own = compute_fit_percent(*compare_speeds(data, found.motion))
    held = _compute_holdout_fit(group, data, found, held_out)
    return FitPercent(*(float(x) if np.isfinite(x) else None for x in (own, held)))


def _compute_holdout_fit(
    group: Sequence[Record], data: Data, found: Fit, held_out: Sequence[Record] | None
) -> float:
    if held_out is None and len(group) < 3:
        return _compute_end_fit(group, data, found)
    chain = found.chain
    if held_out is None:
        fitted, held_out = split_holdout(group)
        part = prepare(fitted, data.current is not None)
        chain = descend(part, chain, found.scales, part.initial, found.noise, max_steps=12).chain
    judged = prepare(held_out, False)
    if judged.is_angle != data.is_angle or not any(np.ptp(r.voltage) for r in held_out):
        return float("nan")
    return compute_fit_percent(
        *compare_speeds(judged, _simulate_under_fitted_load(judged, chain, found.scales))
    )


def _simulate_under_fitted_load(data: Data, chain: Chain, scales: Scales) -> Array:
    """Return the motion simulated freely, its initial states and its constant load fitted."""
    chain = chain.without_slot("current sensor")
    if not chain.has("load"):
        chain = chain.with_component(Load(), {"load": 0.0})
    others = frozenset(p.name for p in chain.parameters) - {"load"}
    motion = replace(data, current=None)
    noise = [Noise.white(1e-3 * float(np.nanstd(data.motion)) or 1.0)]
    chain = replace(chain, fixed=others, constraints=())
    return descend(motion, chain, scales, data.initial, noise, max_steps=12).motion


def _compute_end_fit(group: Sequence[Record], data: Data, found: Fit) -> float:
    """Return the fit of the last part of every record to a chain that was fitted to the rest."""
    held = np.zeros(len(data), dtype=np.bool_)
    at = 0
    for record in group:
        cut = find_holdout_start(record)
        held[at + cut : at + len(record)] = True
        at += len(record)
    voltage = np.concatenate([r.voltage for r in group])
    if not held.any() or np.ptp(voltage[~held]) == 0 or np.ptp(voltage[held]) == 0:
        return float("nan")
    known = replace(
        data,
        motion=np.where(held, np.nan, data.motion),
        current=None if data.current is None else np.where(held, np.nan, data.current),
    )
    again = descend(known, found.chain, found.scales, found.initial, found.noise, max_steps=12)
    measured, simulated = compare_speeds(data, again.motion)
    return compute_fit_percent(
        np.where(held, measured, np.nan), simulated, float(np.nanstd(measured))
    )


def find_holdout_start(record: Record) -> int:
    """Return the row from which a record is held out, its length where it is too short."""
    cut = int(FITTED_SHARE * len(record))
    return len(record) if cut < 2 * MIN_PART_ROWS or len(record) - cut < MIN_PART_ROWS else cut


def split_holdout(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """Divide records into a part to fit and a part to hold out."""
    if len(records) >= 3:
        n = max(1, round((1 - FITTED_SHARE) * len(records)))
        held_out = list(range(1, len(records), max(1, len(records) // n)))[:n]
        return (
            [r for i, r in enumerate(records) if i not in held_out],
            [r for i, r in enumerate(records) if i in held_out],
        )
    fitted, kept_records = [], []
    for record in records:
        cut = find_holdout_start(record)
        fitted.append(record.slice(0, cut))
        if cut < len(record):
            kept_records.append(record.slice(cut, len(record)))
    return fitted, kept_records


def simulate(estimate: Estimate, record: Record) -> tuple[Array, Array]:
    """Return the measured and the freely simulated speed [rad/s] of a recording.

    Only the state at the beginning of each segment is fitted; from there on the motor sees
    nothing but the voltage.
    """
    data = prepare([record], False)
    scales = data.scales(max(estimate.value("time_constant"), data.rows.step))
    scales = replace(scales, volts=estimate.largest_voltage or scales.volts)
    measured, simulated = compare_speeds(
        data, simulate_freely(data, select_motion_chain(estimate, data.is_angle), scales)
    )
    return measured, simulated


def select_motion_chain(estimate: Estimate, is_angle: bool) -> Chain:
    """Return the chain of an estimate as it shows a recording of angles or of speeds."""
    chain = rebuild_chain(estimate.chain)
    sensor = chain.sensor("speed sensor")
    if sensor is None or isinstance(sensor, Angle) != is_angle:
        chain = chain.with_component(Angle() if is_angle else Speed(), {})
    return chain.without_slot("current sensor")
