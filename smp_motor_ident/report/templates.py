# SPDX-License-Identifier: Apache-2.0
"""Render self-contained pages from templates."""

import re
from collections.abc import Sequence
from importlib import resources
from typing import Any

import jinja2
import msgspec
import numpy as np
from markupsafe import Markup, escape

from smp_motor_ident.report import words
from smp_motor_ident.report.drawing import Chart, packed, svg


def page(name: str, charts: Sequence[Chart] | None = None, **content: Any) -> str:
    """Return a page by its template, with the script for ``charts`` if there are any."""
    style = text("colors.css") + text("report.css")
    if charts is not None:
        style = text("uplot/uPlot.min.css") + style
        content |= {
            "charts": charts,
            "data": script_data(charts),
            "draw": lambda chart: Markup(svg(chart)),
            "library": Markup(text("uplot/uPlot.iife.min.js")),
            "script": Markup(text("charts.js") + text("plots.js")),
        }
    return _environment().get_template(name).render(style=Markup(style), **content)


def lab_page(nonce: str, wheels: Sequence[str]) -> str:
    """Return the page of ``lab``, whose script and style run under a nonce."""
    style = "".join(map(text, ("uplot/uPlot.min.css", "colors.css", "report.css", "lab.css")))
    scripts = ("uplot/uPlot.iife.min.js", "charts.js", "lab.js")
    template = _environment().get_template("lab.html.jinja")
    return template.render(
        nonce=nonce, wheels=wheels, style=Markup(style), scripts=[Markup(text(s)) for s in scripts]
    )


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("smp_motor_ident.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "label": words.label,
        "sentence": words.to_sentence,
        "shares": _keep_together,
        "code": _set_code,
    }
    return environment


def _keep_together(shares: str) -> Markup:
    """Return a list whose lines break at its commas only."""
    whole = Markup('<span class="share">{}</span>')
    return Markup(", ").join(whole.format(one) for one in shares.split(", ") if one)


def _set_code(sentence: str) -> Markup:
    """Return a sentence with the names in backticks as code."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(sentence))))


def text(name: str) -> str:
    """Return a file of this folder."""
    return resources.files("smp_motor_ident.report").joinpath(name).read_text("utf-8")


def script_data(content: Any) -> Markup:
    """Return data for a script element, without a ``<`` that could end it."""
    return Markup(encode(content).replace("<", "\\u003c"))


def encode(content: Any) -> str:
    """Return JSON, with arrays in base64."""
    return msgspec.json.encode(content, enc_hook=_plain).decode()


def _plain(value: Any) -> str | float:
    return packed(value) if isinstance(value, np.ndarray) else float(value)
