"""The templates of the pages."""

from __future__ import annotations

import jinja2

from smp_motor_ident.report import words


def template(name: str) -> jinja2.Template:
    """Return a template; what is not given to it is an error."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("smp_motor_ident.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"label": words.label, "number": words.number}
    return environment.get_template(name)
