"""The figures of the report, each from plain results to an SVG element."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from smp_motor_ident.report.series import Comparison, thin
from smp_motor_ident.report.theme import COLOR, canvas, note, styled, to_svg
from smp_motor_ident.report.words import label, scaled
from smp_motor_ident.result import Correlation, Estimate, Quantity, ResidualTests


@styled
def speed(wheel: str, parts: Sequence[Comparison]) -> str:
    """Draw measured against simulated speed, and the voltage below, over all data.

    Parameters
    ----------
    wheel : str
        Name of the wheel.
    parts : sequence of Comparison
        Drawn one after the other; estimation and validation are shaded apart.

    Returns
    -------
    str
        SVG.
    """
    figure, (top, bottom) = canvas(
        9.6, 3.7, nrows=2, sharex=True, gridspec_kw={"height_ratios": [3, 1]}
    )
    begin = 0.0
    for part in parts:
        end = begin + part.time[-1]
        for axes in (top, bottom):
            axes.axvspan(begin, end, color=COLOR[part.role], alpha=0.55, linewidth=0)
        _curves(top, part, begin)
        bottom.plot(*thin(begin + part.time, part.voltage), color=COLOR["voltage"], lw=0.8)
        begin = end
    _role_names(top, parts)
    top.set_ylabel("motor speed [rad/s]")
    top.legend(loc="upper right", ncols=2, bbox_to_anchor=(1.0, 1.2), borderpad=0)
    bottom.set(ylabel="voltage [V]", xlabel="time [s]", xlim=(0, begin))
    figure.align_ylabels()
    return to_svg(figure, f"speed-{wheel}", f"Measured and simulated speed of {label(wheel)}")


def _curves(axes: Axes, part: Comparison, begin: float = 0.0, width: float = 1.0) -> None:
    known = axes.get_legend_handles_labels()[1]
    for name in ("measured", "simulated"):
        axes.plot(
            *thin(begin + part.time, getattr(part, name)),
            color=COLOR[name],
            lw=width,
            alpha=0.9,
            label=None if name in known else name,
        )


def _role_names(axes: Axes, parts: Sequence[Comparison]) -> None:
    """Name each run of stretches of one role once, above its shading."""
    begin, previous = 0.0, ""
    for part in parts:
        if part.role != previous:
            word = "fitted to this" if part.role == "estimation" else "only judged by this"
            axes.annotate(
                word,
                (begin, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(4, 4),
                textcoords="offset points",
                color=COLOR["muted"],
                fontsize=9,
            )
        begin, previous = begin + part.time[-1], part.role


@styled
def detail(wheel: str, parts: Sequence[Comparison]) -> str:
    """Draw the liveliest short stretch of held-out data close up, with its residual below."""
    held_out = [p for p in parts if p.role == "validation"] or list(parts)
    part = _liveliest(held_out)
    figure, (top, bottom) = canvas(
        4.7, 3.7, nrows=2, sharex=True, gridspec_kw={"height_ratios": [3, 1]}
    )
    _curves(top, part, width=1.5)
    top.set_title(f"Close up ({part.role})")
    top.set_ylabel("motor speed [rad/s]")
    top.legend(loc="best")
    bottom.plot(part.time, part.residual, color=COLOR["ink"], lw=0.9)
    bottom.set(ylabel="difference", xlabel="time [s]", xlim=(part.time[0], part.time[-1]))
    figure.align_ylabels()
    return to_svg(figure, f"detail-{wheel}", f"Close-up of the speed of {label(wheel)}")


def _liveliest(parts: Sequence[Comparison], seconds: float = 2.0) -> Comparison:
    """Cut the window in which the voltage moves most."""
    best: tuple[float, Comparison, int, int] | None = None
    for part in parts:
        step = float(np.median(np.diff(part.time)))
        size = min(part.time.size, max(int(seconds / step), 20))
        activity = np.cumsum(np.abs(np.diff(part.measured, prepend=part.measured[0])) > 0)
        moved = activity[size - 1 :] - activity[: activity.size - size + 1]
        first = int(np.argmax(moved))
        if best is None or moved[first] > best[0]:
            best = (float(moved[first]), part, first, first + size)
    assert best is not None
    _, part, first, last = best
    cut = slice(first, last)
    return Comparison(
        part.role,
        part.source,
        part.time[cut],
        part.voltage[cut],
        part.measured[cut],
        part.simulated[cut],
    )


@styled
def residuals(wheel: str, tests: ResidualTests) -> str:
    """Draw the correlation of the residuals with themselves and with the voltage.

    Parameters
    ----------
    wheel : str
        Name of the wheel.
    tests : ResidualTests
        The curves that the verdict is of.

    Returns
    -------
    str
        SVG.
    """
    figure, (top, bottom) = canvas(4.7, 3.7, nrows=2)
    _stems(top, tests.autocorrelation, "Residual autocorrelation")
    _stems(bottom, tests.cross_correlation, "Residual and voltage")
    bottom.set_xlabel("lag [samples]")
    return to_svg(figure, f"residual-{wheel}", f"Residual correlations of {label(wheel)}")


def _stems(axes: Axes, correlation: Correlation | None, title: str) -> None:
    axes.set_title(title)
    if correlation is None:
        note(axes, "too few samples to tell")
        return
    outside = np.abs(correlation.value) > correlation.band
    for flag, name in ((False, "good"), (True, "bad")):
        chosen = (outside == flag) & (correlation.value != 1.0)
        axes.vlines(correlation.lag[chosen], 0, correlation.value[chosen], color=COLOR[name], lw=2)
    axes.axhspan(-correlation.band, correlation.band, color=COLOR["band"], alpha=0.6, lw=0)
    largest = float(np.max(np.abs(correlation.value[correlation.lag != 0])))
    reach = min(1.05, 1.25 * max(largest, 3 * correlation.band))
    axes.set(ylim=(-reach, reach), xlim=(correlation.lag[0] - 1, correlation.lag[-1] + 1))
    axes.grid(axis="x", visible=False)


@styled
def certainty(estimate: Estimate) -> str:
    """Draw how well each quantity is known, as a percentage of itself."""
    held = _without_repeats(estimate)
    figure, axes = canvas(4.7, 0.7 + 0.3 * len(held))
    axes.set(xscale="log", xlim=(1e-3, 300), ylim=(len(held) - 0.4, -0.6))
    for row, quantity in enumerate(held.values()):
        _certainty_bar(axes, row, quantity)
    axes.set_yticks(range(len(held)), [label(name) for name in held], color=COLOR["ink"])
    axes.set_xticks(
        [1e-3, 1e-2, 0.1, 1, 10, 100], ["0.001 %", "0.01 %", "0.1 %", "1 %", "10 %", "100 %"]
    )
    axes.minorticks_off()
    axes.tick_params(left=False)
    axes.grid(axis="y", visible=False)
    axes.set_title("How well each is known (95 %)")
    return to_svg(figure, f"certainty-{estimate.wheel}", "How well each quantity is known")


def _without_repeats(estimate: Estimate) -> dict[str, Quantity]:
    parameters = {n: q for n, q in estimate.parameters.items() if n not in estimate.combinations}
    return {**estimate.combinations, **parameters}


def _certainty_bar(axes: Axes, row: int, quantity: Quantity) -> None:
    left, right = axes.get_xlim()
    if quantity.status == "unidentifiable" or quantity.value is None:
        axes.barh(
            row,
            right - left,
            left=left,
            height=0.62,
            color="none",
            edgecolor=COLOR["bad"],
            hatch="////",
            lw=0,
            alpha=0.55,
        )
        axes.text(1.0, row, "this data cannot tell", ha="center", va="center", fontsize=9)
        return
    if quantity.status == "fixed" or quantity.std is None:
        axes.text(left * 1.3, row, "given", va="center", color=COLOR["muted"], fontsize=9)
        return
    percent = 100.0 * 1.96 * quantity.std / max(abs(quantity.value), 1e-300)
    color = COLOR["good"] if percent < 10 else COLOR["bad"]
    axes.barh(row, percent - left, left=left, height=0.62, color=color, alpha=0.75, lw=0)
    axes.text(percent * 1.2, row, f"± {percent:.2g} %", va="center", fontsize=9, clip_on=True)


@styled
def correlation_matrix(estimate: Estimate) -> str:
    """Draw the correlations between the errors of the estimates."""
    std = np.sqrt(np.diag(estimate.covariance))
    known = np.flatnonzero(std > 0)
    if known.size < 2:
        return ""
    matrix = estimate.covariance[np.ix_(known, known)] / np.outer(std[known], std[known])
    names = [label(estimate.names[k]) for k in known]
    figure, axes = canvas(4.7, 1.3 + 0.3 * known.size)
    for row, column in np.ndindex(*matrix.shape):
        value = matrix[row, column]
        if row > column and known.size <= 6:
            axes.text(column, row, f"{value:+.2f}", ha="center", va="center", fontsize=9)
        elif row != column:
            color = COLOR["measured" if value > 0 else "simulated"]
            axes.scatter(
                column, row, s=1700 / known.size * abs(value), color=color, alpha=0.85, lw=0
            )
        else:
            axes.scatter(column, row, s=8, color=COLOR["muted"], lw=0)
    axes.set(xlim=(-0.5, known.size - 0.5), ylim=(known.size - 0.5, -0.5))
    axes.set_xticks(range(known.size), names, rotation=30, ha="right")
    axes.set_yticks(range(known.size), names)
    axes.tick_params(length=0)
    axes.set_title("Correlation of the errors")
    return to_svg(figure, f"matrix-{estimate.wheel}", "Correlation of the estimation errors")


@styled
def side_by_side(estimates: Mapping[str, Estimate]) -> str:
    """Draw every combination of every wheel with its 95 % interval, wheels side by side."""
    names = [
        name
        for name in ("dc_gain", "time_constant", "time_constant_product", "static_voltage", "delay")
        if any(_has(estimate, name) for estimate in estimates.values())
    ]
    if not names:
        return ""
    figure, axes = canvas(9.6, 1.1 + 0.34 * len(estimates), ncols=len(names), squeeze=False)
    wheels = list(estimates)
    for column, (name, ax) in enumerate(zip(names, axes[0], strict=True)):
        for row, wheel in enumerate(wheels):
            if _has(estimates[wheel], name):
                _dot(ax, row, scaled(estimates[wheel].combinations[name]))
        unit = next(e.combinations[name].unit for e in estimates.values() if _has(e, name))
        ax.set_title(label(name))
        ax.set_xlabel(scaled(Quantity(0.0, unit=unit)).unit)
        ax.set_ylim(len(wheels) - 0.5, -0.5)
        ax.margins(x=0.25)
        ax.locator_params(axis="x", nbins=4)
        names_shown = [label(w) for w in wheels] if column == 0 else [""] * len(wheels)
        ax.set_yticks(range(len(wheels)), names_shown, color=COLOR["ink"])
        ax.tick_params(left=False)
    return to_svg(figure, "wheels", "The wheels' quantities side by side")


def _has(estimate: Estimate, name: str) -> bool:
    quantity = estimate.combinations.get(name)
    return quantity is not None and quantity.value is not None


def _dot(axes: Axes, row: int, quantity: Quantity) -> None:
    assert quantity.value is not None
    color = COLOR[f"wheel-{row % 4 + 1}"]
    if quantity.std is not None:
        half = 1.96 * quantity.std
        axes.plot([quantity.value - half, quantity.value + half], [row, row], color=color, lw=3)
    axes.plot(quantity.value, row, "o", color=color, ms=8, mec=COLOR["surface"], mew=1.5)
