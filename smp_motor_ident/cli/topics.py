"""What recordings offer, and a mapping that may fit: ``identify --topics``."""

import shlex
from collections.abc import Sequence

from rich.console import Console

from smp_motor_ident import bag
from smp_motor_ident.cli.frame import progress
from smp_motor_ident.cli.tables import console

MOST_FIELDS = 12
"""So many fields of a topic are printed."""


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
            out.print(f"{listing.remark}; see docs/mapping.md", soft_wrap=True)
    return 0


def _print_offer(out: Console, offer: bag.Offer) -> None:
    fields = ", ".join(offer.fields[:MOST_FIELDS])
    if len(offer.fields) > MOST_FIELDS:
        fields += f", ... ({len(offer.fields)} fields)"
    indent = ""
    if offer.topic:  # a CSV file has none
        rate = f", {offer.rate:.4g} Hz" if offer.rate else ""
        out.print(f"  {offer.topic}  {offer.type}  {offer.count} messages{rate}", soft_wrap=True)
        indent = "    "
    if fields or offer.remark:
        out.print(f"  {indent}{offer.remark or fields}", soft_wrap=True)
