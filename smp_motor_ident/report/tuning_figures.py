"""Figure of a tuning: step, load step, loop gain and sensitivity of every wheel."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources

import numpy as np

from smp_motor_ident.report.chart import Chart, Curve
from smp_motor_ident.report.drawing import WIDTH, svg
from smp_motor_ident.report.words import label
from smp_motor_ident.tune.arrays import Array
from smp_motor_ident.tune.curves import Curves


def tuning_charts(wheels: Mapping[str, Curves], limit: float, prefix: str = "") -> list[Chart]:
    """Return the charts of the designs of all wheels, each name with a prefix."""
    # Wheels of different time constants are computed over different lengths and bands.
    longest = max(wheels.values(), key=lambda c: float(c.time[-1]))
    time = longest.time
    omega = np.unique(np.concatenate([c.omega for c in wheels.values()]))

    def chart(
        kind: str, title: str, y_label: str, log: str = "", lines: tuple[float, ...] = ()
    ) -> Chart:
        timed = kind in ("step", "load")
        x = time if timed else omega
        bands = {
            wheel: _on(x, c.time if timed else c.omega, getattr(c, kind))
            for wheel, c in wheels.items()
        }
        curves = tuple(
            Curve(label(wheel), rows[1], f"wheel-{k % 4 + 1}", "line", rows[0], rows[2])
            for k, (wheel, rows) in enumerate(bands.items())
        )
        if kind == "step":
            curves += (Curve("reference", _on(x, longest.time, longest.reference), "muted"),)
        return Chart(
            name=prefix + kind, title=title, y_label=y_label, log=log, lines=lines, curves=curves,
            x_label="time [ms]" if timed else "frequency [rad/s]",
            x=1e3 * x if timed else x,
            summary=f"{title}, of {', '.join(map(label, wheels))}",
        )  # fmt: skip

    return [
        chart("step", "Change of set-point", "wheel speed [rad/s]"),
        chart("load", "Load that takes 1 V", "wheel speed [rad/s]"),
        chart("gain", "Loop gain: magnitude", "magnitude", "xy", (1.0,)),
        chart("phase", "Loop gain: phase", "phase [deg]", "x", (-180.0,)),
        chart("sensitivity", f"Sensitivity (line: Ms {limit:g})", "|S|", "x", (limit,)),
        chart("noise", "Control noise", "density [V]", "xy"),
    ]


def _on(x: Array, own: Array, rows: Array) -> Array:
    """Return curves on another axis, shape (..., x.size); NaN outside of their own."""
    flat = [np.interp(x, own, row, left=np.nan, right=np.nan) for row in np.atleast_2d(rows)]
    on: Array = np.array(flat).reshape(*rows.shape[:-1], x.size)
    return on


def tuning_svg(wheels: Mapping[str, Curves], limit: float) -> str:
    """Return the charts one below the other, as an SVG document."""
    parts, top = [], 40
    for k, wheel in enumerate(wheels):
        parts.append(
            f'<circle cx="{80 + 160 * k}" cy="16" r="5" fill="var(--wheel-{k % 4 + 1})"/>'
            f'<text x="{90 + 160 * k}" y="20" font-size="12" fill="var(--ink)">'
            f"{label(wheel)}</text>"
        )
    for chart in tuning_charts(wheels, limit):
        parts.append(
            f'<text x="64" y="{top + 14}" font-size="13" fill="var(--ink)">{chart.title}</text>'
            f'<svg x="0" y="{top + 18}" width="{WIDTH}" height="{chart.height}">{svg(chart)}</svg>'
        )
        top += chart.height + 30
    style = resources.files("smp_motor_ident.report").joinpath("colors.css").read_text("utf-8")
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {top}" '
        f'font-family="sans-serif">'
        f'<style>{style}</style><rect width="100%" height="100%" fill="var(--surface)"/>'
        f"{''.join(parts)}</svg>"
    )
