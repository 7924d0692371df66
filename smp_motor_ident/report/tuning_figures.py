"""Figure of a tuning: step, load step, Bode, sensitivity and Nyquist of every wheel."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from smp_motor_ident.tune.curves import Curves

COLORS = ("#b5179e", "#1b7f3b", "#d1495b", "#1d3557")
_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "tuning",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "legend.fontsize": 8,
}


@matplotlib.rc_context(_STYLE)
def tuning_svg(wheels: Mapping[str, Curves], limit: float) -> str:
    """Draw the designs of all wheels.

    Parameters
    ----------
    wheels : mapping of str to Curves
        By wheel; bands are what 98 % of the motors that the data allow stay within.
    limit : float
        Ms that was promised [-].

    Returns
    -------
    str
        SVG document.
    """
    figure = Figure(figsize=(9, 8.4), layout="constrained")
    (step, load), (gain, phase), (sensitivity, nyquist) = figure.subplots(3, 2)
    for k, (wheel, c) in enumerate(wheels.items()):
        color = COLORS[k % len(COLORS)]
        step.plot(1e3 * c.time, c.reference, color="0.75", lw=3.0, zorder=0)
        _band(step, 1e3 * c.time, c.step, color, wheel)
        _band(load, 1e3 * c.time, c.load, color, wheel)
        _band(gain, c.omega, c.gain, color, wheel)
        _band(phase, c.omega, c.phase, color, wheel)
        _band(sensitivity, c.omega, c.sensitivity, color, wheel)
        turn = np.exp(1j * np.deg2rad(c.phase[1])) * c.gain[1]
        nyquist.plot(turn.real, turn.imag, color=color, lw=1.2)
    figure.legend(*step.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    _label(step, "change of set-point (grey: reference)", "time [ms]", "wheel speed [rad/s]")
    _label(load, "load that takes 1 V", "time [ms]", "wheel speed [rad/s]")
    _label(gain, "loop gain", "frequency [rad/s]", "magnitude", log="loglog")
    gain.axhline(1.0, color="gray", lw=0.8)
    _label(phase, "phase of the loop gain", "frequency [rad/s]", "[deg]", log="x")
    phase.axhline(-180.0, color="gray", lw=0.8)
    phase.set_ylim(-300, -60)
    phase.set_yticks(range(-300, -59, 60))
    for c, color in zip(wheels.values(), COLORS, strict=False):
        crossing = c.omega[np.argmax(c.gain[1] < 1.0)]
        phase.axvline(crossing, color=color, lw=0.8, ls=":")
    phase.annotate(
        "dotted: crossover", (0.02, 0.05), xycoords="axes fraction", fontsize=8, color="gray"
    )
    _label(sensitivity, f"sensitivity (line: Ms {limit:g})", "frequency [rad/s]", "|S|", log="x")
    sensitivity.axhline(limit, color="gray", lw=0.8)
    _label(nyquist, f"loop gain near -1 (circle: Ms {limit:g})", "real part", "imaginary part")
    nyquist.add_patch(Circle((-1, 0), 1 / limit, color="0.9", zorder=0))
    nyquist.plot(-1, 0, "+", color="gray")
    nyquist.set(xlim=(-2.0, 0.6), ylim=(-1.6, 0.8), aspect="equal")
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _band(axes: Axes, x: Any, rows: Any, color: str, label: str) -> None:
    axes.fill_between(x, rows[0], rows[2], color=color, alpha=0.2, lw=0)
    axes.plot(x, rows[1], color=color, lw=1.2, label=label)


def _label(axes: Axes, title: str, x: str, y: str, log: str = "") -> None:
    axes.set_title(title)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if log:
        axes.set_xscale("log")
    if log == "loglog":
        axes.set_yscale("log")
