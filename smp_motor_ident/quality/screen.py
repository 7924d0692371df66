# SPDX-License-Identifier: Apache-2.0
"""Detect bad data before the estimation."""

from collections.abc import Iterator, Sequence

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident import limits
from smp_motor_ident.errors import CurrentError, InsufficientExcitationError, SignalError
from smp_motor_ident.finding import Finding, format_figure
from smp_motor_ident.quality.edge_timer import read_held_share
from smp_motor_ident.quality.glitches import count_glitches
from smp_motor_ident.quality.saturation import refuse_saturation
from smp_motor_ident.quality.signs import correlate_with_voltage, refuse_lost_sign
from smp_motor_ident.quality.silence import refuse_silent_sensor
from smp_motor_ident.quality.units import check_voltage, explain_ratio, refuse_mixed_time_units
from smp_motor_ident.record import Record


def screen_records(records: Sequence[Record]) -> list[Finding]:
    """Refuse records without a valid estimate; name the reason and the remedy."""
    warnings = [*check_voltage(records)]
    where = name_records(records)
    refuse_mixed_time_units(records)
    _check_length(records, where)
    for record in records:
        warnings += _check_lost_samples(record)
    _check_resolution(records, where)
    refuse_lost_sign(records, [measured_speed(r) for r in records], where)
    _check_excitation(records, where)
    for record in records:
        warnings += refuse_saturation(record, measured_speed(record), name_records([record]))
        _check_ratios(record)
    _check_standing(records, where)
    for record in records:
        refuse_silent_sensor(record, name_records([record]))
    _check_motion(records, where)
    _check_signs(records, where)
    for record in _select_turning(records):  # others must not hide a single one
        _check_signs([record], name_records([record]), late=False)
    read = [finding for record in records for finding in record.findings]
    return [*warnings, *(f for k, f in enumerate(read) if f not in read[:k])]


def _check_resolution(records: Sequence[Record], where: str) -> None:
    if any(np.isfinite(measured_speed(r)).any() for r in records):
        return
    if any(r.count is not None and not r.hardware.counts_per_revolution for r in records):
        raise SignalError(
            f"{where}: the counts per revolution are unknown; map counts_per_revolution=N"
        )


def name_records(records: Sequence[Record]) -> str:
    """Return files and wheel in words."""
    sources = ", ".join(dict.fromkeys(r.source for r in records if r.source))
    return f"{sources or 'record'}: {records[0].wheel}"


def _check_length(records: Sequence[Record], where: str) -> None:
    samples = sum(len(r) for r in records)
    if samples < limits.MIN_SAMPLES:
        duration = sum(r.duration for r in records)
        raise InsufficientExcitationError(
            f"{where}: too short, {samples} samples in {duration:.3g} s; record at least "
            f"{limits.MIN_SAMPLES:.0f} samples (faster, or the same again), better 20 s or more "
            "with a changing voltage"
        )


def _check_lost_samples(record: Record) -> Iterator[Finding]:
    where = name_records([record])
    for name in ("velocity", "position"):
        values = getattr(record, name)
        if values is None or (record.count is not None and record.hardware.counts_per_revolution):
            continue
        lost = float(np.mean(~np.isfinite(values)))
        lost -= read_held_share(record) if name == "velocity" else 0.0  # which has a finding
        if lost > limits.MAX_LOST_SHARE and (name == "velocity" or record.velocity is None):
            raise SignalError(
                f"{where}: {name} is NaN in {100 * lost:.0f} % of the samples; "
                "repair the sensor or its connection and record again"
            )
        lost -= count_glitches(record, name) / len(record)  # which have a finding
        if lost > 0:
            yield _report_left_out(name, lost)
    if record.current is not None:
        lost = float(np.mean(~np.isfinite(record.current)))
        if 0 < lost < 1:
            yield _report_left_out("current", lost)


def _report_left_out(name: str, lost: float) -> Finding:
    message = f"{name} is NaN in {100 * lost:.1f} % of the samples; they were left out"
    return Finding("samples_lost", "warning", message, {"signal": name, "share": lost})


def _check_excitation(records: Sequence[Record], where: str) -> None:
    largest = max(float(np.abs(r.voltage).max()) for r in records)
    supply = max(r.hardware.supply_voltage or 0.0 for r in records)
    if largest <= limits.VOLTMETER_SCATTER * supply:
        raise InsufficientExcitationError(
            f"{where}: no excitation, the voltage stays within {format_figure(largest)} V of 0 V; "
            "drive the motor with a sine, square or Fourier voltage while recording"
        )
    # A voltmeter's scatter around a level is not an excitation; a step is one.
    levels = [float(np.mean(r.voltage)) for r in records]
    still = [
        float(np.std(r.voltage)) < limits.VOLTMETER_SCATTER * abs(level)
        and float(np.ptp(r.voltage)) < 10 * limits.VOLTMETER_SCATTER * abs(level)
        for r, level in zip(records, levels, strict=True)
    ]
    one_level = float(np.ptp(levels)) < limits.VOLTMETER_SCATTER * abs(levels[0])
    if all(still) and one_level and not any(_rises_at_start(r) for r in records):
        raise InsufficientExcitationError(
            f"{where}: the voltage is constant at {levels[0]:.4g} V; a constant "
            "input cannot tell dynamics: record a square or Fourier voltage in both directions"
        )


MIN_MEANS = 12  # means of a record that show their scatter


def _rises_at_start(record: Record) -> bool:
    """Return whether a speed rises under a constant voltage: a step before the first row.

    Means over several lengths are compared, since the rise may take few samples or many; their
    noise is the scatter in the last third.
    """
    speed = measured_speed(record)
    speed = speed[np.isfinite(speed)]
    if speed.size < limits.MIN_SAMPLES:
        return False
    length = 1
    while speed.size // length >= MIN_MEANS:
        means = speed[: speed.size // length * length].reshape(-1, length).mean(axis=1)
        last = means[-(len(means) // 3) :]
        steady = float(np.mean(last))
        rise = (steady - float(means[0])) * np.sign(steady)
        if rise > max(0.2 * abs(steady), 6 * float(np.std(last, ddof=1))):
            return True
        length *= 2
    return False


def measured_speed(record: Record) -> Array:
    """Return the best available speed: from counts, angle, or as recorded."""
    per_turn = record.hardware.counts_per_revolution
    if record.count is not None and per_turn:
        angle = record.count * (2 * np.pi / per_turn)
    elif record.velocity is not None:
        return record.velocity
    elif record.position is not None:
        angle = record.position
    else:
        return np.full(len(record), np.nan)
    speed = np.full(len(record), np.nan)
    speed[1:] = np.diff(angle) / np.diff(record.time)
    speed[list(record.starts)] = np.nan
    return speed


def _check_ratios(record: Record) -> None:
    """Compare the signals of the motion with each other; refuse a ratio other than one."""
    per_turn = record.hardware.counts_per_revolution
    angle, what = record.position, "position"
    if record.count is not None and per_turn:
        angle = np.asarray(record.count * (2 * np.pi / per_turn), dtype=np.float64)
        what = "encoder counts"
        if record.position is not None:
            _compare_motions(record, angle, what, record.position, "position")
    if angle is not None and record.velocity is not None:
        charge = np.cumsum(record.velocity[1:] * np.diff(record.time))
        _compare_motions(record, angle, what, np.concatenate([[0.0], charge]), "velocity")


def _compare_motions(
    record: Record, angle: Array, what: str, other_values: Array, other: str
) -> None:
    where = name_records([record])
    lag = max(1, min(10, len(record) // 10))
    dt = record.time[lag:] - record.time[:-lag]
    a, b = (angle[lag:] - angle[:-lag]) / dt, (other_values[lag:] - other_values[:-lag]) / dt
    ok = np.isfinite(a) & np.isfinite(b)
    for s in record.starts[1:]:
        ok[max(0, s - lag) : s] = False
    a, b = a[ok], b[ok]
    if a.size < 20 or b.std() == 0:
        return
    if not np.any(a):
        raise SignalError(
            f"{where}: dead encoder, the {what} stays while the {other} "
            f"reaches {np.abs(b).max():.3g} rad/s; check the encoder's cable"
        )
    together = float(a @ b / np.sqrt((a @ a) * (b @ b)))
    if together < -0.5:
        raise SignalError(
            f"{where}: {what} runs against the {other} (swapped sign); exchange the "
            f"encoder's channels A and B or the sign of the {other}"
        )
    if together <= 0.9:
        return
    # Where either is noisy, or late, their ratio lies between the two regressions (Frisch 1934).
    low, high = float(a @ b / (a @ a)), float(b @ b / (a @ b))
    if low > 1.05 or high < 0.95:
        ratio = float(np.sqrt(low * high))
        raise SignalError(
            f"{where}: {other} is {ratio:.4g} times its value by the {what}; "
            f"{explain_ratio(ratio, record.hardware)}"
        )


def _check_standing(records: Sequence[Record], where: str) -> None:
    """Refuse a speed that stays at 0 or at a sensor's offset for any voltage."""
    speeds = [s[np.isfinite(s)] for s in map(measured_speed, records)]
    speeds = [s for s in speeds if s.size]
    if not speeds or (max(map(np.ptp, speeds)) == 0 and np.ptp([s[0] for s in speeds]) == 0):
        largest = max(float(np.abs(r.voltage).max()) for r in records)
        level = float(speeds[0][0]) + 0.0 if speeds else 0.0  # no -0
        raise SignalError(
            f"{where}: a standing motor or a dead encoder: the speed stays at {level:.3g} rad/s "
            f"while the voltage reaches {largest:.3g} V, no excitation above friction; drive "
            "harder, or check the encoder's cable"
        )


def _check_motion(records: Sequence[Record], where: str) -> None:
    counts = [int(np.ptp(r.count)) for r in records if r.count is not None]
    if counts and len(counts) == len(records) and max(counts) < 20:
        raise InsufficientExcitationError(
            f"{where}: the motor moved by {max(counts)} encoder counts only; "
            "excite with more voltage or for longer"
        )


def _check_signs(records: Sequence[Record], where: str, late: bool = True) -> None:
    """Refuse a speed or current whose sign is wrong, or whose delay hides the sign."""
    for what, remedy in (
        ("speed", "swap the motor's leads or the encoder's channels, or scale it by -1"),
        ("current", "swap the current sensor's sign, or scale it by -1"),
    ):
        kept = [r for r in records if what == "speed" or r.current is not None]
        signals = [measured_speed(r) if what == "speed" else r.current for r in kept]
        found = correlate_with_voltage(
            kept, [s for s in signals if s is not None], lags=what == "speed"
        )
        if found is None:
            continue
        sure = limits.MIN_SIGN_STDS * found.chance
        # Samples of a current between switched voltages show little of it because of the lag.
        least = limits.MIN_SIGN_CORRELATION if what == "speed" else limits.MIN_TURNING_CORRELATION
        most = max(least, min(sure, limits.MIN_TURNING_CORRELATION * found.wrong))
        if found.wrong - found.right > most:
            refusal = SignalError if what == "speed" else CurrentError
            raise refusal(
                f"{where}: swapped sign, {what} runs against the voltage "
                f"(correlation {-found.wrong:.2f}); {remedy}"
            )
        follows = found.wrong > max(least, min(sure, limits.MIN_TURNING_CORRELATION))
        opposite = found.wrong > limits.MIN_WRONG_SIGN_RATIO * found.right
        if late and what == "speed" and follows and opposite:
            changes = sum(np.count_nonzero(np.diff(np.sign(r.voltage))) for r in records)
            period = 2 * sum(len(r) for r in records) / max(changes, 1)
            raise InsufficientExcitationError(
                f"{where}: the voltage changes too fast, with a period of {period:.2g} "
                "samples: a speed delayed by sampling, a filter or a window cannot be told from "
                "one of opposite sign; excite more slowly"
            )


def _select_turning(records: Sequence[Record]) -> list[Record]:
    """Return the records whose motor turned; others show only the sign of an offset."""
    scatter = [float(np.nanstd(measured_speed(r))) for r in records]
    least = limits.MAX_REST_VOLTAGE * max(scatter)
    return [r for r, s in zip(records, scatter, strict=True) if len(records) > 1 and s > least]
