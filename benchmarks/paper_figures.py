# SPDX-License-Identifier: Apache-2.0
"""The figures of docs/paper.md."""

from __future__ import annotations

import matplotlib
from matplotlib.figure import Figure

matplotlib.rcParams.update(
    {
        "svg.fonttype": "none",
        "svg.hashsalt": "paper",
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.alpha": 0.3,
        "legend.frameon": False,
        "legend.fontsize": 8,
        "path.simplify_threshold": 0.5,
    }
)

WHEEL_COLORS = ("magenta", "green", "red", "black")
"""The paper's colours of the four wheels in its Fig. 6; the target is blue."""


def _save(figure, path):
    figure.savefig(path, metadata={"Date": None, "Creator": None})


def fig_5(path, ideal, sampled, step):
    """Draw the step response of motor 1: continuous, and in sampled loops."""
    figure = Figure(figsize=(9, 5.2), layout="constrained")
    axes = figure.subplots(2, 3)
    for row, (reading, (time, y)) in enumerate(ideal.items()):
        axis = axes[row, 0]
        show = time <= (0.05 if reading == "motor" else 0.5)
        axis.plot(1e3 * time[show], y[show], color="magenta")
        axis.axhline(1.0, color="blue", lw=0.8)
        axis.set_title(f"continuous, {reading} reading", loc="left")
        axis.set_ylabel("speed / target")
        for column, rates in enumerate((("100", "200"), ("1000", "5000")), 1):
            axis = axes[row, column]
            for rate, style in zip(rates, ("-", "--"), strict=True):
                t, speed = sampled[f"{reading}, {rate} Hz"]
                axis.plot(1e3 * t, speed / step, style, label=f"{rate} Hz", lw=1)
            axis.axhline(1.0, color="blue", lw=0.8)
            axis.set_title(f"sampled, {reading} reading", loc="left")
            axis.legend(loc="lower right")
    for axis in axes.flat:
        axis.set_xlabel("time [ms]")
        axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
    _save(figure, path)


def fig_6(path, runs, step, ratio):
    """Draw target and actual speed of four wheels for each way of control."""
    figure = Figure(figsize=(9, 5.6), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    for axis, (name, wheels) in zip(axes.ravel(), runs.items(), strict=True):
        axis.plot([0, 0, 600], [0, step / ratio, step / ratio], color="blue", lw=1, label="target")
        for k, ((time, speed), color) in enumerate(
            zip(wheels.values(), WHEEL_COLORS, strict=True), 1
        ):
            show = time <= 0.6
            axis.plot(1e3 * time[show], speed[show] / ratio, color=color, lw=1, label=f"wheel {k}")
        axis.set_title(name, loc="left")
        axis.set_ylim(-0.1, 1.5 * step / ratio)
    for axis in axes[1]:
        axis.set_xlabel("time [ms]")
    for axis in axes[:, 0]:
        axis.set_ylabel("wheel speed [rad/s]")
    axes[0, 0].legend(loc="lower right", ncols=2)
    _save(figure, path)
