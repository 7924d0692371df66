# SPDX-License-Identifier: Apache-2.0
"""Run ``identify``: read, estimate the wheels in parallel, write and print the results."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smp_motor_ident import simulate as simulation
from smp_motor_ident.bag.mapping import SignalMap, load_mapping, parse_mapping
from smp_motor_ident.bag.read import read_experiments
from smp_motor_ident.cli import frame, tables, workers
from smp_motor_ident.cli.identify import NAME
from smp_motor_ident.compilation import load
from smp_motor_ident.errors import BagError, InsufficientExcitationError, ParameterError, SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.infer.planning import what_next
from smp_motor_ident.infer.validation import simulate, split_holdout
from smp_motor_ident.quality.excitation import select_excerpts
from smp_motor_ident.record import Record
from smp_motor_ident.report import figures, history, summary, words
from smp_motor_ident.report.document import (
    check_free,
    identification_document,
    motors_yaml,
    now,
    write_together,
)
from smp_motor_ident.result import UNITS, Estimate, to_json

if TYPE_CHECKING:
    from smp_motor_ident.report.tuning_page import Tuning
    from smp_motor_ident.tune import Loop

COMPILED = Path(simulation.__file__).parent / "__pycache__"
"""Default folder of numba's compiled code."""

OUTPUTS = ("identification.json", "motors.yaml", "report.html")


@dataclass(frozen=True)
class Outcome:
    """Result for one wheel: an estimate with its curves, or the reason for its absence."""

    estimate: Estimate | None = None
    comparisons: tuple[figures.Comparison, ...] = ()
    failure: SmpError | None = None
    recorded: tuple[float, ...] = ()  # when its recordings began [s since 1970]

    @property
    def exit_code(self) -> int:
        """Exit code: 0 for a reliable estimate."""
        if self.failure is not None:
            return self.failure.exit_code
        return int(self.estimate is not None and self.estimate.unreliable)


def work(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    if arguments.topics:
        return tables.print_topics(arguments.bags, arguments.msg, NAME)
    loop = None if arguments.controller is None else reconstruction(arguments)
    mapping = signal_map(arguments) if loop is None else setpoint_map(arguments)
    if not arguments.output:
        raise ParameterError("--output DIR is missing; give a folder for the results")
    fixed = fixed_parameters(arguments.fix)
    if arguments.fleet:
        if loop is not None or arguments.validate:
            raise ParameterError(
                "--fleet excludes --controller and --validate; identify these recordings alone"
            )
        from smp_motor_ident.cli import fleet

        return fleet.work(arguments, mapping, fixed)
    paths = [Path(arguments.output) / name for name in OUTPUTS]
    check_free(paths, arguments.force)
    with frame.progress(NAME, arguments.quiet, "5 to 30 s for a motor") as say:
        if not arguments.quiet and not any(COMPILED.glob("*.nbi")):
            print(f"{NAME}: compiling for this machine, only this once ...", file=sys.stderr)
        say("reading")
        records = _read(arguments.bags, mapping, arguments.wheel)
        kept = _read(arguments.validate, mapping, list(records)) if arguments.validate else {}
        if loop is not None:
            records = {wheel: list(map(loop, group)) for wheel, group in records.items()}
            kept = {wheel: list(map(loop, group)) for wheel, group in kept.items()}
        jobs = {
            wheel: partial(identify_wheel, group, kept.get(wheel, ()), arguments.model, fixed)
            for wheel, group in records.items()
        }
        if len(jobs) > 1:
            load()
        outcomes = workers.in_parallel(jobs, say)
        if any(outcome.estimate for outcome in outcomes.values()):
            tunings = _tunings(outcomes, say) if arguments.tuning else {}
            say("writing the report")
            contents = _contents(outcomes, arguments, tunings)
            write_together(dict(zip(paths, contents, strict=True)), arguments.force)
    return _conclude(outcomes, paths, arguments)


def fixed_parameters(items: Sequence[str]) -> dict[str, float]:
    """Read ``--fix`` arguments."""
    fixed = _numbers(items, "--fix", UNITS)
    for name, value in fixed.items():
        if not 0 <= value < float("inf"):
            raise ParameterError(
                f"--fix {name}={value:g}; it must be zero or positive, in {UNITS[name]}"
            )
    return fixed


def _numbers(items: Sequence[str], option: str, known: Mapping[str, object]) -> dict[str, float]:
    """Read arguments ``NAME=VALUE``."""
    numbers = {}
    for item in items:
        name, _, text = item.partition("=")
        if name not in known:
            raise ParameterError(f"{option} {item}: it takes {', '.join(known)}")
        try:
            numbers[name] = float(text)
        except ValueError:
            raise ParameterError(f"{option} {item}: {text!r} is not a number") from None
    return numbers


def signal_map(arguments: argparse.Namespace) -> SignalMap | None:
    """Return the mapping in the arguments."""
    if arguments.map and arguments.mapping:
        raise ParameterError("--map and --mapping exclude each other; write all into the file")
    if arguments.mapping:
        loaded = load_mapping(arguments.mapping)
        return replace(loaded, msg_files=(*loaded.msg_files, *arguments.msg))
    if not (arguments.map or arguments.msg):
        return None
    return parse_mapping(arguments.map, arguments.msg)


def _read(
    paths: Sequence[str], mapping: SignalMap | None, wheels: Sequence[str]
) -> dict[str, list[Record]]:
    """Read the requested wheels, or all."""
    found = read_experiments(list(paths), mapping)
    for wheel in wheels:
        if wheel not in found:
            raise BagError(f"{', '.join(paths)}: has no wheel {wheel!r}; it has {', '.join(found)}")
    return {wheel: found[wheel] for wheel in wheels} if wheels else found


def identify_wheel(
    records: Sequence[Record],
    kept: Sequence[Record],
    model: str,
    fixed: Mapping[str, float],
    say: Callable[[str], None],
) -> Outcome:
    """Estimate one motor; a refusal is an outcome too, with its reason."""
    records, kept = select_excerpts(records), select_excerpts(kept)
    try:
        found = estimate(records, model, fixed=fixed, validation=list(kept) or None, progress=say)
    except ParameterError:
        raise
    except SmpError as error:
        return Outcome(failure=error)
    except np.linalg.LinAlgError as error:
        # A numerical failure of one wheel must not discard the results of the others.
        text = (
            f"{records[0].source}: {records[0].wheel}: the estimation failed ({error}); "
            "record a longer excitation with several frequencies, in both directions"
        )
        return Outcome(failure=InsufficientExcitationError(text))
    judged = found.fit_percent.validation is not None
    fitted, held_out = (records, kept) if kept or not judged else split_holdout(records)
    parts: dict[figures.Role, Sequence[Record]] = {"estimation": fitted, "validation": held_out}
    compared = [
        figures.Comparison(role, one.source, one.time, one.voltage, *simulate(found, one))
        for role, part in parts.items()
        for one in part
    ]
    recorded = tuple(r.recorded for r in (*records, *kept) if r.recorded is not None)
    return Outcome(found, tuple(compared), recorded=recorded)


def _tunings(outcomes: Mapping[str, Outcome], say: Callable[..., None]) -> dict[str, Tuning]:
    """Design controllers for the tuning page, as `tune` does without arguments."""
    from smp_motor_ident.cli import tune, tuning
    from smp_motor_ident.report import tuning_page

    usual = tune.parser().parse_args(["identification"])
    known = {wheel: out.estimate for wheel, out in outcomes.items() if out.estimate}
    loops: dict[str, Loop] = {}
    unknown: dict[str, Tuning] = {}
    say("designing for the tuning page, which takes some 20 s")
    for wheel, found in known.items():
        try:
            loop = tuning.loop_for(found, usual)
            loops |= tuning.choose_sources({wheel: found}, {wheel: loop}, {})[0]
        except SmpError as error:  # such as of a motor whose supply is not known
            unknown[wheel] = tuning_page.Tuning(wheel, reason=str(error))

    designs, refused = tuning_page.design_all_wheels({w: known[w] for w in loops}, loops)
    jobs = {
        wheel: lambda _, w=wheel, own=own: tuning_page.design_tuning(known[w], loops[w], own)
        for wheel, own in designs.items()
    }
    return {**unknown, **refused, **workers.in_parallel(jobs, say, "designing for")}


def _contents(
    outcomes: Mapping[str, Outcome], arguments: argparse.Namespace, tunings: Mapping[str, Tuning]
) -> list[str]:
    """Return the three files' texts, in the order of :data:`OUTPUTS`."""
    from smp_motor_ident.report.html import Report, render

    date = now()
    recorded = sorted({words.date(t) for outcome in outcomes.values() for t in outcome.recorded})
    provenance = {
        "Recordings": ", ".join(Path(path).name for path in arguments.bags),
        "Recorded": ", ".join(recorded),
        "Judged by": ", ".join(Path(path).name for path in arguments.validate)
        or "parts of the same recordings that were held out",
        "Command": arguments.command,
        "Date": date,
        "Versions": ", ".join(
            f"{name} {metadata.version(name)}" for name in ("smp_motor_control", "numpy", "numba")
        ),
    }
    estimates = {wheel: one.estimate for wheel, one in outcomes.items() if one.estimate}
    since = history.read(Path(arguments.history)) if arguments.history else {}
    report = Report(
        estimates,
        {wheel: one.comparisons for wheel, one in outcomes.items()},
        {wheel: str(one.failure) for wheel, one in outcomes.items() if one.failure},
        provenance,
        tunings,
        {wheel: history.history_charts(wheel, entries) for wheel, entries in since.items()},
        arguments.output,
    )
    head = [f"Identified {date} by {NAME} from {provenance['Recordings']}.", "SI, motor shaft."]
    document = to_json(identification_document(estimates))
    return [document, motors_yaml(estimates, head), render(report)]


def _conclude(
    outcomes: Mapping[str, Outcome], paths: Sequence[Path], arguments: argparse.Namespace
) -> int:
    """Print the results; return the exit code."""
    estimates = {wheel: one.estimate for wheel, one in outcomes.items() if one.estimate}
    if not arguments.quiet and estimates:
        out = tables.console()
        for found in estimates.values():
            tables.print_estimate(out, found, arguments.verbose)
            if arguments.what_next:
                text = what_next(found, arguments.accuracy).words
                out.print(f"Next: {words.to_sentence(text)}", soft_wrap=True)
            out.print()
        out.print(f"written: {', '.join(map(str, paths))}", soft_wrap=True)
        advice = (summary.advise_tuning(one, arguments.output) for one in estimates.values())
        for text, command in dict.fromkeys(advice):
            out.print(f"{text} {command}", soft_wrap=True)
    code = 0
    for wheel, one in outcomes.items():
        if one.failure:
            print(f"{NAME}: {one.failure}", file=sys.stderr)
        elif one.exit_code and not arguments.accept_unreliable:
            print(f"{NAME}: {wheel}: {_describe_unreliable(estimates[wheel])}", file=sys.stderr)
        else:
            continue
        code = max(code, one.exit_code)
    return code


def _describe_unreliable(found: Estimate) -> str:
    """Return which numbers are unreliable and what to record next, in one line."""
    grave = [f for f in found.findings if f.severity in ("unreliable", "refused")]
    codes = ", ".join(dict.fromkeys(f.code for f in grave))
    advice = dict.fromkeys(words.to_sentence(f.advice) for f in grave if f.advice)
    first = f"{summary.judge(found)[1]} ({codes})."
    return " ".join([first, *advice, "--accept-unreliable takes it as it is."])


_SETPOINT = re.compile(r"(^|\s|\.)setpoint=")

Reconstruct = Callable[[Record], Record]


def setpoint_map(arguments: argparse.Namespace) -> SignalMap:
    """Return the mapping, with the set-point in place of the voltage."""
    items: list[str] = arguments.map
    if arguments.mapping or not any(_SETPOINT.search(item) for item in items):
        raise ParameterError(
            "--controller needs --map setpoint=... velocity=...: the loop's set-point, in its own "
            "unit, and its measurement"
        )
    if any(re.search(r"(^|\s|\.)voltage=", item) for item in items):
        raise ParameterError("--controller computes the voltage; leave out voltage=")
    mapping = parse_mapping([_SETPOINT.sub(r"\1voltage=", item) for item in items], arguments.msg)
    motors = {}
    for wheel, plan in mapping.motors.items():
        signals = dict(plan.signals)
        if "velocity" not in signals:
            raise ParameterError(f"--controller: {wheel}: map the velocity that the loop measured")
        if signals["voltage"].topic != signals["velocity"].topic:
            raise ParameterError(
                f"--controller: {wheel}: set-point and velocity must come from one message or row; "
                "with two topics their steps of the loop cannot be matched"
            )
        signals["voltage"] = replace(signals["voltage"], unit="V")
        motors[wheel] = replace(plan, signals=signals, held="after")
    return replace(mapping, motors=motors)


def reconstruction(arguments: argparse.Namespace) -> Reconstruct:
    """Return a function that replaces set-points by the voltages of the known loop."""
    from smp_motor_ident.tune.exports import FORMATS
    from smp_motor_ident.tune.known_loop import reconstruct

    name, *items = arguments.controller
    if name not in FORMATS:
        raise ParameterError(f"--controller {name}; it must be one of {', '.join(FORMATS)}")
    loop = FORMATS[name].known
    numbers = {**loop.defaults, **_numbers(items, f"--controller {name}", loop.defaults)}
    missing = [key for key, value in numbers.items() if math.isnan(value)]
    if missing:
        raise ParameterError(f"--controller {name}: give {', '.join(f'{k}=...' for k in missing)}")
    return lambda record: reconstruct(record, loop, numbers)
