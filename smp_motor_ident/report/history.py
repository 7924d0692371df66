# SPDX-License-Identifier: Apache-2.0
"""Store and draw the live estimates of `identifier` over days.

Each line of the file is a JSON object: stamp [s], wheel, values with standard deviations, and codes
of findings.  Lines are only appended, so a crash loses one line at most.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec
import numpy as np

from smp_motor_ident.errors import BagError
from smp_motor_ident.live.monitor import Monitor
from smp_motor_ident.report.drawing import Chart, Curve
from smp_motor_ident.report.words import label

SHOWN = {
    "resistance": "resistance [ohm]",
    "motor_constant": "motor constant [V s/rad]",
    "friction": "friction [times the commissioned]",
}


@dataclass(frozen=True)
class Entry:
    """One wheel at one time."""

    stamp: float  # [s]
    wheel: str
    # Estimate and standard deviation by name
    values: Mapping[str, tuple[float, float]]
    findings: tuple[str, ...] = ()  # codes


def entry_of(stamp: float, wheel: str, monitor: Monitor) -> Entry:
    """Return a monitor's present estimates."""
    known = {name for name, (state, _) in monitor.validity().items() if state == "estimated"}
    values = {name: one for name, one in monitor.values().items() if name in known}
    return Entry(stamp, wheel, values, tuple(f.code for f in monitor.findings()))


def append(path: Path, entries: Sequence[Entry]) -> None:
    """Add entries to a file."""
    with path.open("a", encoding="utf-8") as file:
        for one in entries:
            file.write(json.dumps(asdict(one), allow_nan=False) + "\n")


def read(path: Path) -> dict[str, list[Entry]]:
    """Return the entries of each wheel by their stamps; a truncated last line is left out."""
    out: dict[str, list[Entry]] = {}
    lines = path.read_text("utf-8").splitlines()
    for number, line in enumerate(lines, 1):
        try:
            one = msgspec.json.decode(line, type=Entry)
        except msgspec.DecodeError as error:
            if number == len(lines):
                break  # the power went while it was written
            raise BagError(
                f"{path}: line {number} is not an entry of a history ({error})"
            ) from None
        out.setdefault(one.wheel, []).append(one)
    return {wheel: sorted(entries, key=lambda e: e.stamp) for wheel, entries in out.items()}


def history_charts(wheel: str, entries: Sequence[Entry]) -> list[Chart]:
    """Return a chart of each value over the hours since the first entry, with 95 % bands."""
    if len(entries) < 2:
        return []
    hours = np.array([(e.stamp - entries[0].stamp) / 3600 for e in entries])
    charts = []
    for name, title in SHOWN.items():
        pairs = np.array([e.values.get(name, (math.nan, math.nan)) for e in entries])
        if not np.isfinite(pairs[:, 0]).any():
            continue
        value, wide = pairs[:, 0], 1.96 * pairs[:, 1]
        curve = Curve("live, 95 % band", value, "measured", "line", value - wide, value + wide)
        charts.append(Chart(
            name=f"history-{name}-{wheel}", title=f"Since commissioning: {label(name).lower()}",
            x_label="time [h]", y_label=title, x=hours, curves=(curve,), group=f"history-{wheel}",
            summary=f"{title} of {label(wheel)} over {hours[-1]:.3g} hours.",
        ))  # fmt: skip
    return charts
