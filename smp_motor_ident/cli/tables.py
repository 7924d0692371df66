"""What tools print: results as tables, for a terminal, a pipe or a log, and what a bag offers."""

import shlex
import sys
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from smp_motor_ident import bag
from smp_motor_ident.cli.frame import progress
from smp_motor_ident.report import words
from smp_motor_ident.result import Estimate

MOST_FIELDS = 12  # so many fields of a topic are printed
_COLOR = {"estimated": "green", "fixed": "cyan", "unidentifiable": "red"}


def console() -> Console:
    """Return the console of standard output; wide enough for a table when it is no terminal."""
    return Console(width=None if sys.stdout.isatty() else 110, highlight=False, markup=False)


def table(title: str, *columns: str) -> Table:
    """Return an empty table; its first column is of words."""
    made = Table(title=title or None, title_justify="left", title_style="bold")
    made.box, made.pad_edge = box.SIMPLE_HEAD, False
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
    apart = ["systematic"] if estimate.systematic else []
    columns = ("quantity", "value", "std", "95 % interval", "unit", *apart, "status")
    made = table(", ".join(title), *columns)
    for column in made.columns[4:]:
        column.justify = "left"
    for name, quantity in {**estimate.combinations, **estimate.parameters}.items():
        made.add_row(
            name,
            words.number(quantity.value, quantity.std),
            words.spread(quantity.std),
            words.interval(quantity),
            quantity.unit,
            *(words.systematic(quantity) for _ in apart),
            Text(words.status(quantity), style=_COLOR[quantity.status]),
        )
    return made


_WHAT_TO_MAP = (
    "where one of the above is, say which: --map voltage=… velocity=… (or position=…, count=…); "
    "where it is in another file, give both: voltage=/FILE.COLUMN; a level that no column holds is "
    "voltage=COLUMN*0+VOLTS; without a voltage or a command none can be identified; see "
    "docs/mapping.md"
)


def list_topics(paths: Sequence[str], msg_files: Sequence[str], program: str) -> int:
    """Print what recordings offer, and a mapping that may fit."""
    out = console()
    with progress(program) as say:
        say("reading")
        listings = bag.list_topics(list(paths), msg_files)
    for listing in listings:
        out.print(listing.name, style="bold")
        for offer in listing.offers:
            _print_offer(out, offer)
        for finding in listing.findings:
            out.print(f"{finding.severity}: {finding.message}", soft_wrap=True)
        if not listing.needs_mapping:
            out.print("no mapping is needed: the wheels are described by our own messages")
        elif listing.suggestion:
            given = " ".join(shlex.quote(item) for item in listing.suggestion)
            out.print(f"suggestion: --map {given}", soft_wrap=True)
            for text in listing.asked:
                out.print(f"  to be added: {text}", soft_wrap=True)
            if listing.remark:
                out.print(f"  note: {listing.remark}", soft_wrap=True)
        else:
            out.print(f"{listing.remark}; {_WHAT_TO_MAP}", soft_wrap=True)
    return 0


def _print_offer(out: Console, offer: bag.Offer) -> None:
    fields = ", ".join(offer.fields[:MOST_FIELDS])
    if len(offer.fields) > MOST_FIELDS:
        fields += f", ... ({len(offer.fields)} fields)"
    indent = ""
    if offer.table and offer.count:
        fields = f"of {offer.count} rows: {fields}"
    if offer.topic:  # a CSV file has none
        rate = f", {offer.rate:.4g} Hz" if offer.rate else ""
        out.print(f"  {offer.topic}  {offer.type}  {offer.count} messages{rate}", soft_wrap=True)
        indent = "    "
    if fields or offer.remark:
        out.print(f"  {indent}{offer.remark or fields}", soft_wrap=True)
