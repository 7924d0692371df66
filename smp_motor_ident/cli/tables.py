"""Results as tables for a terminal, a pipe or a log."""

import sys

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from smp_motor_ident.report import words
from smp_motor_ident.result import Estimate

_COLOR = {"estimated": "green", "fixed": "cyan", "unidentifiable": "red"}


def console() -> Console:
    """Return the console of standard output; wide enough for a table when it is no terminal."""
    return Console(width=None if sys.stdout.isatty() else 110, highlight=False, markup=False)


def table(title: str, *columns: str) -> Table:
    """Return an empty table; its first column is of words."""
    made = Table(
        title=title or None,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for k, column in enumerate(columns):
        made.add_column(column, justify="left" if k == 0 else "right", no_wrap=True)
    return made


def estimate_table(estimate: Estimate) -> Table:
    """Return what is known of one motor."""
    fit = estimate.fit_percent
    title = [f"{words.label(estimate.wheel)}: {words.model(estimate.model)}"]
    if fit.estimation is not None:
        title.append(f"fit {fit.estimation:.2f} %")
    if fit.validation is not None:
        title.append(f"held out {fit.validation:.2f} %")
    made = table(", ".join(title), "quantity", "value", "std", "95 % interval", "unit", "status")
    made.columns[4].justify = made.columns[5].justify = "left"
    for name, quantity in {**estimate.combinations, **estimate.parameters}.items():
        made.add_row(
            name,
            words.number(quantity.value, quantity.std),
            words.spread(quantity.std),
            words.interval(quantity),
            quantity.unit,
            Text(words.status(quantity), style=_COLOR[quantity.status]),
        )
    return made
