"""Many recordings in one table: robots, wheels and dates, what drifts and what stands out."""

import csv
import io
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from smp_motor_ident.report import templates
from smp_motor_ident.report.limits import FLEET_DRIFT, FLEET_OUTLIER, FLEET_SIZE

QUANTITIES = ("dc_gain", "time_constant", "static_voltage", "resistance", "motor_constant")
"""What is compared, where the recordings tell it."""

DAY = 86400.0


@dataclass(frozen=True)
class Row:
    """One motor in one recording."""

    # robot, wheel, source: whose it is, and the recording
    robot: str
    wheel: str
    source: str
    date: float  # when it was recorded [s since 1970]
    values: Mapping[str, tuple[float, float]]  # value and standard deviation by name
    fit_percent: float | None = None  # of the speed in held-out data; None where there is none
    unreliable: bool = False  # whether the identification calls itself so
    failure: str = ""  # why there are no values
    lost: bool = False  # whether that was not the recording's fault: the next run tries it again


@dataclass(frozen=True)
class Mark:
    """Something that stands out: a drift of one motor, or a motor unlike the others."""

    kind: str
    robot: str
    wheel: str
    quantity: str
    text: str  # in words, with the numbers


def drifts(rows: Sequence[Row]) -> list[Mark]:
    """Return which motors change with time, by a straight line through their values.

    The deviation of the slope is the larger of that from the stated deviations and that from the
    scatter around the line.
    """
    marks = []
    for (robot, wheel, name), held in _grouped(rows, lambda r: r.robot).items():
        day = np.array([r.date / DAY for r in held])
        value, std = np.array([r.values[name] for r in held]).T
        if len(held) < 3 or np.ptp(day) == 0 or not np.all(std > 0):
            continue
        middle = np.average(day, weights=std**-2.0)  # there the line is at the mean
        (slope, mean), stated = np.polyfit(day - middle, value, 1, w=1 / std, cov="unscaled")
        rest = (value - mean - slope * (day - middle)) / std
        scatter = max(1.0, float(np.sum(rest**2)) / (len(held) - 2))
        if abs(slope) > FLEET_DRIFT.value * math.sqrt(scatter * stated[0, 0]):
            share = 100 * slope * 30 / mean
            text = f"{share:+.2g} % in 30 days, over {len(held)} recordings"
            marks.append(Mark("drift", robot, wheel, name, text))
    return marks


def outliers(rows: Sequence[Row]) -> list[Mark]:
    """Return which motors differ from the same wheel of the other robots.

    Each robot's last value against the median of the robots, in units of their scatter
    (1.4826 times the median deviation, and no less than what is stated of the value itself).
    """
    marks = []
    for (_, wheel, name), held in _grouped(rows, lambda r: "").items():
        last = list({r.robot: r for r in sorted(held, key=lambda r: r.date)}.values())
        if len(last) < FLEET_SIZE.value:
            continue
        value, std = np.array([r.values[name] for r in last]).T
        middle = float(np.median(value))
        spread = np.hypot(1.4826 * np.median(np.abs(value - middle)), std)
        for row, one, wide in zip(last, value, spread, strict=True):
            if wide > 0 and abs(one - middle) > FLEET_OUTLIER.value * wide:
                share = 100 * (one / middle - 1)
                text = f"{share:+.2g} % from the median of {len(last)} robots"
                marks.append(Mark("outlier", row.robot, wheel, name, text))
    return marks


def _grouped(
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
        pairs = [r.values.get(name) for r in rows]
        out[name] = [p[0] if p else None for p in pairs]
        out[f"{name}_std"] = [p[1] if p else None for p in pairs]
    return out | plain("fit_percent", "unreliable", "failure")


def table(rows: Sequence[Row]) -> tuple[str, bytes]:
    """Return the name and content of the table: Parquet where pyarrow is installed, else CSV."""
    held = columns(rows)
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        text = io.StringIO(newline="")
        writer = csv.writer(text)
        writer.writerow(held)
        writer.writerows(zip(*held.values(), strict=True))
        return "fleet.csv", text.getvalue().encode()
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.table(held), sink)
    return "fleet.parquet", sink.getvalue().to_pybytes()


def page(rows: Sequence[Row], marks: Sequence[Mark]) -> str:
    """Return the table as a page that stands alone."""
    robots = len({r.robot for r in rows})
    return templates.page(
        "fleet.html.jinja",
        rows=rows,
        marks=marks,
        quantities=QUANTITIES,
        robots=robots,
        day=lambda date: str(np.datetime64(round(date), "s")).replace("T", " "),
    )
