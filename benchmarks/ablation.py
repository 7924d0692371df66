# SPDX-License-Identifier: Apache-2.0
"""Leave out each component of the catalogue and each stage of the estimator in turn.

Every so many records of `frozen`, without the costliest fifth, are estimated with everything and
again without one thing.  For a component, records with its effect in middle strength are added, and
only records in which it was fitted count.  Right answers rank before uncertain ones, those before
wrong ones; among right answers those stated to 5 % come first.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import frozen
import numpy as np
from known_motors import table

import smp_motor_ident.chain.chain as chain
import smp_motor_ident.estimate as story
import smp_motor_ident.fit.descend as descend
import smp_motor_ident.fit.search as search
import smp_motor_ident.infer.uncertainty as uncertainty
from smp_motor_ident.chain.catalogue import find_component

SHARE = 0.8  # share of the records: those with the lowest cost
Patch = tuple[Any, str, Any]
simulate, find, guess, noise = chain.simulate, search.search, search.guess_motors, descend.fit_noise


def policy(**changes: object) -> list[Patch]:
    """Return the patch that searches under another policy."""
    return [(story, "search", lambda data, p, say: find(data, replace(p, **changes), say))]


SWITCHES: dict[str, list[Patch]] = {
    "search": policy(max_rounds=0, restarts=False),
    "restarts with a component": policy(restarts=False),
    "exchanges": policy(max_exchangeable=-1),
    "second and third candidate": policy(max_candidates=1),
    "extra price": policy(extra_price=0.0),
    "lag re-attributed": [(search, "replace_second_lag", lambda *_: ())],
    "size along the signature": [(search, "_scale_to_optimum", lambda *_: None)],
    "dropping": [(search, "_drop_unneeded", lambda found, *_: found)],
    "second and third guess": [
        (search, "guess_motors", lambda data, _, one=None: guess(data, 1, one))
    ],
    "thinning for the search": [(story, "MIN_SEARCH_ROWS", 10**9)],
    "whitening": [(descend, "fit_noise", lambda rest, runs, _=0: noise(rest, runs, 0))],
    "finer pieces": [(chain, "PIECES_PER_LAG", 2.0)],
    "trimming to the excitation": [(story, "find_excitation", lambda record: (0, len(record)))],
    "adequacy in the intervals": [(uncertainty, "compute_scatters", lambda *_: [])],
    "absent components": [(uncertainty, "assess_absent_components", lambda *_: [])],
    "priors in the intervals": [(uncertainty, "assess_priors", lambda *_: [])],
}


for name in ("OPTIONAL", "SPEED_SENSORS", "CURRENT_SENSORS"):
    whole = getattr(search, name)
    for one in whole:
        if one.code not in ("friction", "current"):  # every chain begins with these
            SWITCHES[one.code] = [(search, name, tuple(c for c in whole if c is not one))]


def identified(job: frozen.Job, patches: list[Patch] | tuple[()] = ()) -> dict[str, Any]:
    """Return the outcome of a record without something, its cost, and the steps taken."""
    said: list[str] = []
    costs: list[int] = []  # rows simulated, by every pass

    def counted(rows: Any, pieces: Any, lanes: Any, *more: Any) -> Any:
        costs.append(pieces.length.size * lanes.shape[1])
        return simulate(rows, pieces, lanes, *more)

    with ExitStack() as stack:
        for one in [(chain, "simulate", counted), *patches]:
            stack.enter_context(patch.object(*one))
        return {**frozen.identify(job, said.append)[1], "cost": sum(costs), "said": said}


def fitted(name: str, row: dict[str, Any]) -> bool:
    """Return whether something took part in a record; each current sensor always does."""
    one = find_component(name)
    begun = one and {f"fitting {one.title}", f"beginning again with {one.title}"} & set(row["said"])
    current = one in search.CURRENT_SENSORS and row["about"].endswith(" current")
    return not one or bool(begun) or current


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--every", type=int, default=13, help="of the frozen records")
    parser.add_argument("--only", nargs="*", choices=[*SWITCHES], metavar="NAME")
    args = parser.parse_args()
    base = {job: identified(job) for job in frozen.jobs()[:: args.every]}
    most = float(np.quantile([row["cost"] for row in base.values()], SHARE))
    first = [job for job, row in base.items() if row["cost"] <= most]
    ranks = [frozen.rank(base[job])[0] for job in first]
    print(f"{len(first)} of {len(base)} records: {ranks.count(0)} right, {ranks.count(2)} wrong\n")
    rows = []
    for name in args.only or SWITCHES:
        own = [j for j in frozen.jobs() if j[1] == 1 and name in frozen.EFFECTS[j[0]].causes]
        base |= {job: identified(job) for job in own if job not in base}
        jobs = dict.fromkeys([*first, *(job for job in own if base[job]["cost"] <= most)])
        runs = [job for job in jobs if fitted(name, base[job])]
        pairs = [(base[job], identified(job, SWITCHES[name])) for job in runs]
        ranked = [(frozen.rank(with_it), frozen.rank(without)) for with_it, without in pairs]
        cost = sum(with_it["cost"] - without["cost"] for with_it, without in pairs)
        share = cost / sum(base[job]["cost"] for job in jobs)
        changed = sum(frozen.differs(*pair) for pair in pairs)
        better, worse = sum(a < b for a, b in ranked), sum(a > b for a, b in ranked)
        rows.append((name, len(jobs), len(runs), changed, better, worse, f"{100 * share:+.0f} %"))
        print(*rows[-1], sep=" | ", file=sys.stderr, flush=True)
    head = ("with", "records", "fitted in", "changed", "better", "worse", "rows simulated")
    print(table(head, rows))


if __name__ == "__main__":
    main()
