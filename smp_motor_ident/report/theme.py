"""One look for every figure: SVG whose colours are the page's CSS variables.

matplotlib draws with marker colours that occur nowhere else; :func:`to_svg` replaces each by
``var(--name)``, so one figure serves light, dark and print.
"""

from __future__ import annotations

import io
import re
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_NAMES = (
    "ink",
    "muted",
    "grid",
    "surface",
    "measured",
    "simulated",
    "voltage",
    "estimation",
    "validation",
    "band",
    "good",
    "bad",
    "wheel-1",
    "wheel-2",
    "wheel-3",
    "wheel-4",
)
COLOR = {name: f"#0100{index:02x}" for index, name in enumerate(_NAMES, 1)}
"""Marker colour of each CSS variable of the page."""

_MARKER = re.compile("|".join(f"{marker}\\b" for marker in COLOR.values()))
_NAME_OF = {marker: name for name, marker in COLOR.items()}
_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "font.size": 10,
    "font.family": "sans-serif",
    "text.color": COLOR["ink"],
    "axes.labelcolor": COLOR["muted"],
    "axes.edgecolor": COLOR["grid"],
    "axes.titlecolor": COLOR["ink"],
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": COLOR["grid"],
    "grid.linewidth": 0.7,
    "xtick.color": COLOR["muted"],
    "ytick.color": COLOR["muted"],
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    "figure.facecolor": "none",
    "lines.solid_joinstyle": "round",
    "path.simplify": True,
    "path.simplify_threshold": 0.3,
}


styled = matplotlib.rc_context(_STYLE)
"""Decorator of every function that draws."""


def canvas(width: float, height: float, **layout: Any) -> tuple[Figure, Any]:
    """Return an empty figure in the page's style, with its axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(**layout)


def note(axes: Axes, text: str) -> None:
    """Write a remark in the middle of empty axes.

    Parameters
    ----------
    axes : Axes
        Which lose their ticks.
    text : str
        The remark.
    """
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)


def to_svg(figure: Figure, name: str, description: str) -> str:
    """Return a figure as an SVG element to set into a page."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r'\b(id="|url\(#|href="#)', rf"\g<1>{name}-", text)
    text = re.sub(r"font: ([^;\"]*?px) [^;\"]*", r"font: \1 var(--font)", text)
    text = re.sub(r'<svg ([^>]*?)width="[^"]*pt" ?', r"<svg \1", text, count=1)
    text = re.sub(r'<svg ([^>]*?)height="[^"]*pt" ?', r"<svg \1", text, count=1)
    label = description.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    text = text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
    return _MARKER.sub(lambda match: f"var(--{_NAME_OF[match[0]]})", text)
