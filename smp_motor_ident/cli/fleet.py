# SPDX-License-Identifier: Apache-2.0
"""``identify --fleet``: every recording by itself, over all cores or a cluster, in one table.

Each recording's result is kept in ``DIR/done``, keyed by names, sizes and times of its files, the
options and the version.  Existing results are not computed again, so an interrupted run resumes;
a recording that fails becomes a row with its reason.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from importlib import metadata
from pathlib import Path
from typing import Any, cast

import msgspec

from smp_motor_ident.bag.mapping import SignalMap
from smp_motor_ident.bag.read import read_experiments
from smp_motor_ident.cli.workers import end_with_parent
from smp_motor_ident.errors import BagError, ParameterError, SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.quality.excitation import select_excerpts
from smp_motor_ident.report import fleet, words
from smp_motor_ident.report.document import check_free, write_together
from smp_motor_ident.result import plain

MAX_ATTEMPTS = 2  # largest number of tries for a recording that kills its worker

Results = Iterator[tuple[str, list[fleet.Row]]]
"""Paths of recordings, each with its rows."""


def work(
    arguments: argparse.Namespace, mapping: SignalMap | None, fixed: Mapping[str, float]
) -> int:
    """Identify every recording by itself, and write the table."""
    folder = Path(arguments.output)
    name, _ = fleet.table([])
    check_free([folder / name, folder / "fleet.html"], arguments.force)
    done = folder / "done"
    done.mkdir(parents=True, exist_ok=True)
    options = json.dumps([repr(mapping), arguments.model, sorted(arguments.fix)])
    files = {path: done / f"{_hash_inputs(Path(path), options)}.json" for path in arguments.bags}
    left = [path for path, file in files.items() if not file.exists()]
    if not arguments.quiet:
        print(f"{len(files) - len(left)} of {len(files)} recordings are known already")
    decode = msgspec.json.Decoder(list[fleet.Row]).decode
    results = {p: decode(f.read_bytes()) for p, f in files.items() if f.exists()}
    settings = (mapping, arguments.model, dict(fixed))
    for path, found in _identify_all(left, settings, arguments.scheduler):
        results[path] = found
        if not any(row.lost for row in found):
            write_together({files[path]: msgspec.json.encode(plain(found))}, force=True)
        if not arguments.quiet:
            print("\n".join(map(fleet.describe, found)), flush=True)
    rows = [row for path in files for row in results[path]]
    marks = [*fleet.drifts(rows), *fleet.outliers(rows)]
    name, content = fleet.table(rows)
    pages: dict[Path, str | bytes] = {
        folder / name: content,
        folder / "fleet.html": fleet.page(rows, marks),
    }
    write_together(pages, arguments.force)
    if not arguments.quiet:
        for mark in marks:
            what = words.label_in_sentence(mark.quantity)
            print(f"{mark.kind}: {fleet.name_motor(mark)}: {what} {mark.text}")
        print(f"written: {', '.join(map(str, pages))}")
    return int(any(row.failure or row.unreliable for row in rows))


def _hash_inputs(path: Path, options: str) -> str:
    """Return a hash of everything that a result depends on."""
    if not path.exists():
        raise BagError(f"{path}: no such file or folder")
    parts = sorted(path.rglob("*")) if path.is_dir() else [path]
    seen = [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in parts if p.is_file()]
    version = metadata.version("smp_motor_control")
    text = json.dumps(["rows with intervals", str(path.resolve()), seen, options, version])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def identify_one(path: str, settings: tuple[Any, ...]) -> list[fleet.Row]:
    """Return the rows of one recording, one per wheel; a failure is a row too."""
    mapping, model, fixed = settings
    rows = []
    try:
        for wheel, records in read_experiments([path], mapping).items():
            dates = [one.recorded for one in records if one.recorded is not None]
            about: dict[str, Any] = dict(wheel=wheel, date=min(dates, default=None))
            try:
                found = estimate(select_excerpts(records), model, fixed=fixed)
            except SmpError as error:
                rows.append(_make_row(path, **about, failure=str(error)))
                continue
            held = {**found.combinations, **found.parameters}
            known = ((name, held.get(name)) for name in fleet.QUANTITIES)
            values = {name: q for name, q in known if q is not None and q.value is not None}
            verdict = dict(fit_percent=found.fit_percent.validation, unreliable=found.unreliable)
            rows.append(_make_row(path, **about, values=values, **verdict))
    except SmpError as error:
        return [_make_row(path, failure=str(error))]
    except Exception as error:  # one bad recording must not end the others
        return [_make_row(path, failure=f"{path}: {type(error).__name__}: {error}")]
    return rows


def _make_row(path: str, **what: Any) -> fleet.Row:
    """Return a row of a recording; the robot is the folder that it lies in."""
    where = Path(path).resolve()
    about = {"wheel": "", "values": {}, "date": None, **what}
    return fleet.Row(robot=where.parent.name, source=where.name, **about)


def _identify_all(
    paths: Sequence[str], settings: tuple[Any, ...], scheduler: str | None
) -> Results:
    """Yield results as they come; a dying worker loses only its own recording."""
    if scheduler:
        yield from identify_on_cluster(paths, settings, scheduler)
        return
    fork = multiprocessing.get_context("fork")
    tries = dict.fromkeys(paths, 0)
    while tries:
        cores = min(len(os.sched_getaffinity(0)), len(tries))
        with ProcessPoolExecutor(cores, mp_context=fork, initializer=end_with_parent) as pool:
            try:
                futures = {pool.submit(identify_one, path, settings): path for path in tries}
                for future in as_completed(futures):
                    result = future.result()
                    del tries[futures[future]]
                    yield futures[future], result
            except BrokenProcessPool:
                # The recording is unknown: those in progress are tried again, one at a time.
                for path in list(tries)[: 1 if cores == 1 else cores]:
                    tries[path] += 1
        for path in [p for p, n in tries.items() if n >= MAX_ATTEMPTS]:
            del tries[path]
            why = f"{path}: its worker was killed, perhaps for lack of memory"
            yield path, [_make_row(path, failure=why, lost=True)]


def identify_on_cluster(paths: Sequence[str], settings: tuple[Any, ...], address: str) -> Results:
    """Yield results from the workers of a Dask cluster, which reruns the jobs of dead workers."""
    try:
        from dask import distributed
    except ImportError:
        raise ParameterError(
            "--scheduler needs Dask (pip install distributed); without it, all local cores work"
        ) from None
    call = cast(Callable[..., Any], distributed.as_completed)
    try:
        client = cast(Callable[..., Any], distributed.Client)(address, timeout="10s")
    except OSError as error:
        raise ParameterError(
            f"--scheduler {address}: no Dask scheduler answers ({error})"
        ) from None
    with client:
        futures = {client.submit(identify_one, p, settings, pure=False): p for p in paths}
        for future in call(futures):
            path = futures[future]
            lost = future.exception()
            failed = [_make_row(path, failure=f"{path}: {lost}", lost=True)]
            yield path, future.result() if lost is None else failed
