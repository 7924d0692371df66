# SPDX-License-Identifier: Apache-2.0
"""Describe charts as data for the script of a page, and draw them as SVG for print and files."""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from importlib import resources
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array
from smp_motor_ident.report.words import label

WIDTH = 720
LEFT, RIGHT, TOP, BOTTOM = 64, 12, 8, 40
POINTS = 600  # drawn points of a curve, about one a pixel


@dataclass(frozen=True, eq=False)
class Curve:
    """One line, row of points or row of bars over the chart's x."""

    name: str  # in the legend
    y: Array  # shape (n,): NaN where there is nothing
    color: str  # CSS variable of the page
    kind: Literal["line", "points", "bars"] = "line"
    # low, high: shape (n,): band around the line
    low: Array | None = None
    high: Array | None = None
    width: float = 1.5  # of a line [px]


@dataclass(frozen=True, eq=False)
class Chart:
    """Curves over one x."""

    name: str  # identifier in the page
    # title, x_label, y_label: with units
    title: str
    x_label: str
    y_label: str
    x: Array  # shape (n,): increasing
    curves: tuple[Curve, ...]
    log: str = ""
    lines: tuple[float, ...] = ()  # marked levels
    # Stretches of x with the CSS variable that shades them
    spans: tuple[tuple[float, float, str], ...] = ()
    group: str = ""  # charts of one group share cursor and zoom in x
    height: int = 220
    view: tuple[float, float] | None = None  # range of x that a screen shows at first
    summary: str = ""  # description of the chart for screen readers


def packed(values: Array) -> str:
    """Return numbers as base64 of little-endian float32: 5 bytes each, and quick to read."""
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()


def resample(x: Array, own: Array, rows: Array) -> Array:
    """Return curves on another axis, shape (..., x.size); NaN outside of their own."""
    flatten = [np.interp(x, own, row, left=np.nan, right=np.nan) for row in np.atleast_2d(rows)]
    return np.array(flatten).reshape(*rows.shape[:-1], x.size)


def thin(values: Array, points: int) -> NDArray[np.intp]:
    """Return the indices of the smallest and largest value of each of ``points / 2`` stretches."""
    if values.size <= points:
        return np.arange(values.size)
    size = -(-values.size // (points // 2))
    rows = values[: values.size - values.size % size].reshape(-1, size)
    begin = np.arange(rows.shape[0]) * size
    low = np.where(np.isfinite(rows), rows, np.inf).argmin(axis=1)
    high = np.where(np.isfinite(rows), rows, -np.inf).argmax(axis=1)
    index = np.concatenate((begin + low, begin + high, [0, values.size - 1]))
    return np.asarray(np.unique(index))


def svg(chart: Chart) -> str:
    """Return the chart as an SVG element whose colours are CSS variables."""
    plane = _Plane(chart)
    parts = [
        f'<svg class="static" role="img" viewBox="0 0 {WIDTH} {chart.height}" '
        f'aria-label="{escape(chart.summary or chart.title)}">'
    ]
    for begin, end, color in chart.spans:
        x = plane.x(np.array([begin, end]))
        parts.append(
            f'<rect x="{x[0]:.0f}" y="{TOP}" width="{x[1] - x[0]:.0f}" '
            f'height="{plane.bottom - TOP}" fill="var(--{color})"/>'
        )
    parts += plane.axes()
    for level in chart.lines:
        y = plane.y(np.array([level]))[0]
        parts.append(
            _draw_path(f"M{LEFT} {y:.1f}H{WIDTH - RIGHT}", "muted", 'stroke-dasharray="4 3"')
        )
    for curve in chart.curves:
        parts += plane.curve(curve)
    return "".join([*parts, "</svg>"])


def document(charts: Sequence[Chart], wheels: Sequence[str]) -> str:
    """Return charts one below the other as an SVG file, the colours of the wheels above them."""
    parts, top = [], 40
    for k, wheel in enumerate(wheels):
        parts.append(
            f'<circle cx="{80 + 160 * k}" cy="16" r="5" fill="var(--wheel-{k % 4 + 1})"/>'
            f'<text x="{90 + 160 * k}" y="20" font-size="12" fill="var(--ink)">'
            f"{label(wheel)}</text>"
        )
    for chart in charts:
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


def _draw_path(way: str, color: str, more: str = "") -> str:
    return f'<path d="{way}" fill="none" stroke="var(--{color})" {more}/>'


class _Plane:
    """Conversion from the units of a chart to those of the drawing."""

    def __init__(self, chart: Chart) -> None:
        self.chart = chart
        self.bottom = chart.height - BOTTOM
        values = [a for c in chart.curves for a in (c.y, c.low, c.high) if a is not None]
        values.append(np.array(chart.lines))
        self._x_range = _find_range([chart.x], "x" in chart.log, 0.0)
        self._y_range = _find_range(values, "y" in chart.log, 0.05)
        self.x = partial(_place, (LEFT, WIDTH - RIGHT), self._x_range, "x" in chart.log)
        self.y = partial(_place, (self.bottom, TOP), self._y_range, "y" in chart.log)

    def axes(self) -> list[str]:
        parts = []
        for tick in ticks(*self._x_range, "x" in self.chart.log):
            x = self.x(np.array([tick]))[0]
            parts.append(_draw_path(f"M{x:.1f} {TOP}V{self.bottom}", "grid"))
            parts.append(_draw_text(x, self.bottom + 15, f"{tick:g}", "middle"))
        for tick in ticks(*self._y_range, "y" in self.chart.log, 5):
            y = self.y(np.array([tick]))[0]
            parts.append(_draw_path(f"M{LEFT} {y:.1f}H{WIDTH - RIGHT}", "grid"))
            parts.append(_draw_text(LEFT - 6, y + 4, f"{tick:g}", "end"))
        middle = (TOP + self.bottom) / 2
        parts.append(_draw_text((LEFT + WIDTH) / 2, self.bottom + 33, self.chart.x_label, "middle"))
        turned = f'transform="rotate(-90 14 {middle:.0f})"'
        parts.append(_draw_text(14, middle, self.chart.y_label, "middle", turned))
        return parts

    def curve(self, curve: Curve) -> list[str]:
        parts = []
        if curve.low is not None and curve.high is not None:
            ok = np.isfinite(curve.low) & np.isfinite(curve.high)
            x, high, low = self.x(self.chart.x[ok]), self.y(curve.high[ok]), self.y(curve.low[ok])
            way = _draw_polyline(np.concatenate((x, x[::-1])), np.concatenate((high, low[::-1])))
            parts.append(f'<path d="{way}" fill="var(--{curve.color})" fill-opacity=".2"/>')
        keep = thin(curve.y, POINTS)
        x, y = self.x(self.chart.x[keep]), self.y(curve.y[keep])
        if curve.kind == "line":
            behind = ' stroke-opacity=".5"' if curve.width > 2 else ""
            look = f'stroke-width="{curve.width:g}"{behind}'
            parts.append(_draw_path(_draw_polyline(x, y), curve.color, look))
            return parts
        ok = np.isfinite(y)
        if curve.kind == "bars":
            zero = self.y(np.zeros(1))[0]
            way = "".join(f"M{a:.1f} {zero:.1f}V{b:.1f}" for a, b in zip(x[ok], y[ok]))
            parts.append(_draw_path(way, curve.color, 'stroke-width="3"'))
        else:
            way = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x[ok], y[ok]))
            parts.append(_draw_path(way, curve.color, 'stroke-width="5" stroke-linecap="round"'))
        return parts


def _find_range(values: Sequence[Array], log: bool, margin: float) -> tuple[float, float]:
    everything = np.concatenate([np.ravel(v) for v in values])
    everything = everything[np.isfinite(everything) & ((everything > 0) | (not log))]
    if everything.size == 0:
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(everything.min()), float(everything.max())
    if low == high:
        low, high = (low / 2, high * 2) if log else (low - 1.0, high + 1.0)
    wide = 0.0 if log else margin * (high - low)
    return low - wide, high + wide


def _place(
    edges: tuple[float, float], ends: tuple[float, float], log: bool, values: Array
) -> Array:
    (first, last), (low, high) = edges, ends
    with np.errstate(invalid="ignore", divide="ignore"):
        if log:
            values, low, high = np.log(values / low), 0.0, math.log(high / low)
        share = (values - low) / (high - low)
    return np.asarray(first + np.clip(share, -0.02, 1.02) * (last - first))


def ticks(low: float, high: float, log: bool = False, about: int = 8) -> list[float]:
    """Return round numbers between two ends, about so many; powers of ten where logarithmic."""
    if log:
        powers = range(math.ceil(math.log10(low)), math.floor(math.log10(high)) + 1)
        found = [10.0**k for k in powers]
        if len(found) >= 2:
            return found
    rough = (high - low) / about
    size = 10.0 ** math.floor(math.log10(rough))
    step = next(m * size for m in (1, 2, 5, 10) if m * size >= rough)
    first, last = math.ceil(low / step), math.floor(high / step)
    return [round(k * step, 12) for k in range(first, last + 1)]


def _draw_polyline(x: Array, y: Array) -> str:
    """Return a path that is interrupted where there is no value."""
    way, down = [], False
    for a, b in zip(x.tolist(), y.tolist()):
        if b != b:
            down = False
            continue
        way.append(f"{'L' if down else 'M'}{a:.1f} {b:.1f}")
        down = True
    return "".join(way)


def _draw_text(x: float, y: float, text: str, anchor: str, more: str = "") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="11" '
        f'fill="var(--muted)" {more}>{escape(text)}</text>'
    )
