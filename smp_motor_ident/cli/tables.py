# SPDX-License-Identifier: Apache-2.0
"""Print results and a bag's topics as tables, for a terminal, a pipe or a log."""

import shlex
import sys
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from smp_motor_ident.bag.propose import list_topics
from smp_motor_ident.bag.topics import TopicInfo
from smp_motor_ident.cli.frame import progress
from smp_motor_ident.report import summary, words
from smp_motor_ident.result import Estimate

MAX_FIELDS = 12  # largest number of printed fields per topic
WIDE_COLUMNS = 110  # columns of a terminal that has room for 95 % intervals
_COLOR = {"good": "green", "fair": "yellow", "poor": "red"}


def console() -> Console:
    """Return the console of standard output, wide enough for a table if not a terminal."""
    return Console(width=None if sys.stdout.isatty() else 140, highlight=False, markup=False)


def table(title: str, *columns: str) -> Table:
    """Return an empty table whose first column is left-aligned."""
    made = Table(title=title or None, title_justify="left", title_style="bold")
    made.box, made.pad_edge = box.SIMPLE_HEAD, False
    for k, column in enumerate(columns):
        made.add_column(column, justify="left" if k == 0 else "right", no_wrap=True)
    return made


def print_estimate(out: Console, estimate: Estimate, verbose: bool = False) -> None:
    """Print one motor like the report: verdict, numbers, and the gravest messages, or all."""
    grade, verdict = summary.judge(estimate)
    title = f"{words.label(estimate.wheel)}: {words.model(estimate.model)}"
    out.print(title, style="bold", soft_wrap=True)
    out.print(Text(f"{verdict}.", style=_COLOR[grade]), summary.describe_fit(estimate))
    out.print(_values(estimate, intervals=out.width >= WIDE_COLUMNS))
    shown, other = summary.select_messages(estimate)
    for one in (*shown, *other) if verbose else shown:
        text = f"{one.number}. {one.severity.capitalize()}: {one.text} {one.advice}".rstrip()
        out.print(text, soft_wrap=True)
    if other and not verbose:
        more = f"{len(other)} more finding{'s' if len(other) > 1 else ''}"
        out.print(f"{more}: in the report, or with --verbose.")


def _values(estimate: Estimate, intervals: bool) -> Table:
    """Return the known numbers and ranges of a motor."""
    held = {**estimate.combinations, **estimate.parameters}
    doubted = summary.find_doubted(estimate)
    made = table("", "quantity", "value", *(["95 % interval"] if intervals else []), "systematic")
    for column in made.columns:
        column.justify = "left"
    made.columns[-1].no_wrap = False
    for name, quantity in held.items():
        if words.is_stated(quantity):
            remark = [words.systematic(quantity)]
            if quantity.status != "estimated":
                remark.append(words.status(quantity))
            if name in doubted:
                remark.append(f"unreliable, see {doubted[name]}")
            cells = [words.label(name), words.state(quantity)]
            if intervals:
                cells.append("" if quantity.value is None else words.interval(quantity))
            made.add_row(*cells, ", ".join(filter(None, remark)))
    hidden = [words.label_in_sentence(n) for n, q in held.items() if not words.is_stated(q)]
    if hidden:
        made.caption = f"not identifiable: {', '.join(hidden)}"
        made.caption_justify = "left"
    return made


_MAPPING_ADVICE = (
    "map the columns above: --map voltage=… velocity=… (or position=…, count=…); with several "
    "files: voltage=/FILE.COLUMN; a constant voltage: voltage=COLUMN*0+VOLTS. Without a voltage or "
    "a command no motor can be identified; see docs/mapping.md"
)


def print_topics(paths: Sequence[str], msg_files: Sequence[str], program: str) -> int:
    """Print the topics of recordings, and a suggested mapping."""
    out = console()
    with progress(program) as say:
        say("reading")
        listings = list_topics(list(paths), msg_files)
    for listing in listings:
        out.print(listing.name, style="bold")
        for info in listing.topics:
            _print_topic(out, info)
        for finding in listing.findings:
            out.print(f"{finding.severity}: {finding.message}", soft_wrap=True)
        if not listing.needs_mapping:
            out.print("no mapping is needed: the wheels are described by smp_interfaces messages")
        elif listing.suggestion:
            given = " ".join(shlex.quote(item) for item in listing.suggestion)
            out.print(f"suggestion: --map {given}", soft_wrap=True)
            for text in listing.asked:
                out.print(f"  to be added: {text}", soft_wrap=True)
            if listing.remark:
                out.print(f"  note: {listing.remark}", soft_wrap=True)
        else:
            out.print(f"{listing.remark}; {_MAPPING_ADVICE}", soft_wrap=True)
    return 0


def _print_topic(out: Console, info: TopicInfo) -> None:
    fields = ", ".join(info.fields[:MAX_FIELDS])
    if len(info.fields) > MAX_FIELDS:
        fields += f", ... ({len(info.fields)} fields)"
    indent = ""
    if info.table and info.count:
        fields = f"of {info.count} rows: {fields}"
    if info.topic:  # a CSV file has none
        rate = f", {info.rate:.4g} Hz" if info.rate else ""
        out.print(f"  {info.topic}  {info.type}  {info.count} messages{rate}", soft_wrap=True)
        indent = "    "
    if fields or info.remark:
        out.print(f"  {indent}{info.remark or fields}", soft_wrap=True)
