"""Figure of a tuning: step, load step, loop gain and sensitivity of every wheel."""

from collections.abc import Mapping

import numpy as np

from smp_motor_ident.report.chart import Chart, Curve
from smp_motor_ident.report.drawing import document
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
    return np.array(flat).reshape(*rows.shape[:-1], x.size)


def tuning_svg(wheels: Mapping[str, Curves], limit: float) -> str:
    """Return the charts one below the other, as an SVG document."""
    return document(tuning_charts(wheels, limit), list(wheels))
