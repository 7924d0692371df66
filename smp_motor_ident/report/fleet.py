# SPDX-License-Identifier: Apache-2.0
"""Tabulate many recordings by robot, wheel and date; find drifts and outliers."""

import csv
import io
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.limits import MIN_FLEET_DRIFT, MIN_FLEET_OUTLIER, MIN_FLEET_SIZE
from smp_motor_ident.report import templates, words
from smp_motor_ident.result import UNITS, Quantity

QUANTITIES = ("dc_gain", "time_constant", "static_voltage", "resistance", "motor_constant")
"""Quantities compared, where the recordings determine them."""

DAY = 86400.0


@dataclass(frozen=True)
class Row:
    """One motor in one recording."""

    # robot, wheel, source: name of each, and of the recording
    robot: str
    wheel: str
    source: str
    date: float | None  # when it was recorded [s since 1970], by its own stamps
    values: Mapping[str, Quantity]  # compared quantities by name
    fit_percent: float | None = None  # fit on held-out data; None without such data
    unreliable: bool = False  # whether the identification is unreliable
    failure: str = ""  # reason for missing values
    lost: bool = False  # whether the failure is not due to the recording, so the next run retries


@dataclass(frozen=True)
class Mark:
    """A drift of one motor, or an outlier among the robots."""

    kind: str
    robot: str
    wheel: str
    quantity: str
    text: str  # in words, with the numbers


def name_motor(row: Row | Mark) -> str:
    """Return robot and wheel of a motor."""
    return f"{row.robot}, {words.label_in_sentence(row.wheel)}" if row.wheel else row.robot


def drifts(rows: Sequence[Row]) -> list[Mark]:
    """Return the motors that change with time, by a straight line through their values.

    The standard deviation of the slope is the larger of that from the stated deviations and that
    from the scatter around the line.  Systematic errors are common to all recordings and left out.
    """
    marks = []
    dated = [row for row in rows if row.date is not None]
    for (robot, wheel, name), held in _group_rows(dated, lambda r: r.robot).items():
        day = np.array([(r.date or 0.0) / DAY for r in held])
        value, std = _read_values(held, name)
        if len(held) < 3 or np.ptp(day) == 0 or not np.all(std > 0):
            continue
        middle = np.average(day, weights=std**-2.0)  # where the line has the mean value
        (slope, mean), stated = np.polyfit(day - middle, value, 1, w=1 / std, cov="unscaled")
        rest = (value - mean - slope * (day - middle)) / std
        scatter = max(1.0, float(np.sum(rest**2)) / (len(held) - 2))
        deviation = math.sqrt(scatter * stated[0, 0])
        if abs(slope) > MIN_FLEET_DRIFT * deviation:
            shown = Quantity(3000 * slope / mean, abs(3000 * deviation / mean), unit="%")
            text = (
                f"changes by {words.state(shown)} in 30 days, {abs(slope) / deviation:.1f} "
                f"standard deviations over {len(held)} recordings in {np.ptp(day):.3g} days"
            )
            marks.append(Mark("drift", robot, wheel, name, text))
    return marks


def _read_values(rows: Sequence[Row], name: str) -> tuple[Array, Array]:
    """Return the values of a quantity and their standard deviations."""
    pairs = [(r.values[name].value, r.values[name].std or 0.0) for r in rows]
    value, std = np.array(pairs, dtype=np.float64).T
    return value, std


def outliers(rows: Sequence[Row]) -> list[Mark]:
    """Return the motors that differ from the same wheel of the other robots.

    Each robot's last value against the median of the robots, in units of their scatter
    (1.4826 times the median deviation, but at least the value's own standard deviation).
    """
    marks = []
    for (_, wheel, name), held in _group_rows(rows, lambda r: "").items():
        last = list({r.robot: r for r in sorted(held, key=lambda r: r.date or 0.0)}.values())
        if len(last) < MIN_FLEET_SIZE:
            continue
        value, std = _read_values(last, name)
        middle = float(np.median(value))
        spread = np.hypot(1.4826 * np.median(np.abs(value - middle)), std)
        for row, one, wide in zip(last, value, spread, strict=True):
            if wide > 0 and abs(one - middle) > MIN_FLEET_OUTLIER * wide:
                shown = words.state(row.values[name])
                text = (
                    f"is {shown}, {100 * (one / middle - 1):+.2g} % from the median of "
                    f"{len(last)} robots, {abs(one - middle) / wide:.1f} times their scatter"
                )
                marks.append(Mark("outlier", row.robot, wheel, name, text))
    return marks


def _group_rows(
    rows: Sequence[Row], robot_of: Callable[[Row], str]
) -> dict[tuple[str, str, str], list[Row]]:
    found: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in rows:
        if not row.unreliable:
            for name in row.values:
                found[robot_of(row), row.wheel, name].append(row)
    return found


def columns(rows: Sequence[Row]) -> dict[str, list[object]]:
    """Return the table by columns; a number that does not exist is None."""

    def plain(*names: str) -> dict[str, list[object]]:
        return {name: [getattr(row, name) for row in rows] for name in names}

    out = plain("robot", "wheel", "date", "source")
    for name in QUANTITIES:
        held = [r.values.get(name, Quantity(None)) for r in rows]
        out[name] = [q.value for q in held]
        out[f"{name}_std"] = [q.std for q in held]
        out[f"{name}_low"] = [q.ci95 and q.ci95[0] for q in held]
        out[f"{name}_high"] = [q.ci95 and q.ci95[1] for q in held]
    return out | plain("fit_percent", "unreliable", "failure")


def table(rows: Sequence[Row]) -> tuple[str, bytes]:
    """Return the name and content of the table: Parquet where pyarrow is installed, else CSV."""
    held = columns(rows)
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        text = io.StringIO(newline="")
        csv.writer(text).writerows([held, *zip(*held.values(), strict=True)])
        return "fleet.csv", text.getvalue().encode()
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.table(held), sink)
    return "fleet.parquet", sink.getvalue().to_pybytes()


def describe(row: Row) -> str:
    """Return the result of one motor in one recording, in a line."""
    if row.failure:
        return row.failure
    numbers = (f"{words.label_in_sentence(n)} {words.state(q)}" for n, q in row.values.items())
    fit = [] if row.fit_percent is None else [f"fit {row.fit_percent:.1f} %"]
    text = ", ".join([*numbers, *fit, *(["unreliable"] if row.unreliable else [])])
    return f"{row.robot}/{row.source}: {row.wheel}: {text}"


def page(rows: Sequence[Row], marks: Sequence[Mark]) -> str:
    """Return the table as a self-contained page."""
    known = [name for name in QUANTITIES if any(name in row.values for row in rows)]
    units = {name: words.scaled(Quantity(None, unit=UNITS[name])).unit for name in known}
    dates = sorted(row.date for row in rows if row.date is not None)

    def count(which: Callable[[Row], bool]) -> int:
        return len({(r.robot, r.source) for r in rows if which(r)})

    return templates.page(
        "fleet.html.jinja",
        rows=sorted(rows, key=lambda r: (r.robot, r.wheel, r.date or 0.0)),
        marks=marks,
        quantities={n: f"{words.label(n)} [{words.format_unit(units[n])}]" for n in known},
        robots=len({r.robot for r in rows}),
        motors=len({(r.robot, r.wheel) for r in rows if r.wheel}),
        recordings=count(lambda r: True),
        span=[words.date(one) for one in dict.fromkeys((*dates[:1], *dates[-1:]))],
        undated=count(lambda r: r.date is None and not r.failure),
        failed=count(lambda r: bool(r.failure)),
        words=words,
        where=name_motor,
    )
