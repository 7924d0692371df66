"""``identify``: from recordings to motors, each number with its certainty."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from functools import partial
from importlib import metadata
from pathlib import Path

import numpy as np

from smp_motor_ident import bag
from smp_motor_ident.cli.frame import Parser, progress, run
from smp_motor_ident.cli.tables import console, estimate_table
from smp_motor_ident.cli.topics import list_topics
from smp_motor_ident.diagnosis.identifiability import what_next
from smp_motor_ident.diagnosis.validation import split
from smp_motor_ident.errors import (
    BagError,
    InsufficientExcitationError,
    ParameterError,
    SmpError,
)
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.predict import simulate
from smp_motor_ident.record import Record
from smp_motor_ident.report.document import (
    check_free,
    identification_document,
    motors_yaml,
    write_together,
)
from smp_motor_ident.report.series import Comparison, Role
from smp_motor_ident.result import UNITS, Estimate

NAME = "identify"
OUTPUTS = ("identification.json", "motors.yaml", "report.html")

DESCRIPTION = """\
Identify the DC motors in one or more recordings, and write DIR/identification.json (results
with their certainty), DIR/motors.yaml (a parameter file for motor_plant) and DIR/report.html
(figures and explanations, in one file).
"""
EPILOG = """\
examples:
  identify drive_bag --output result
  identify monday tuesday --validate wednesday --fix resistance=12.9 --output result
  identify --topics robot_bag
  identify robot_bag --output result --map voltage=/pwm.data*12/255 \\
           --map velocity=/joint_states.velocity[left_wheel_joint]
  identify log.csv --output result --map time=t voltage=u velocity=y:deg/s

exit codes: 0 every wheel identified; 1 the data of some or all wheels do not support an answer
(the wheels that could be identified are written; the message says what to record next);
2 wrong usage or unreadable input (nothing is written).
"""


Say = Callable[[str], None]


@dataclass
class Results:
    """What came out, by wheel: an estimate with its curves, or the reason why there is none."""

    estimates: dict[str, Estimate] = field(default_factory=dict)
    comparisons: dict[str, list[Comparison]] = field(default_factory=dict)
    failures: dict[str, SmpError] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = Parser(
        prog=NAME,
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = made.add_argument
    add("bags", nargs="+", metavar="BAG", help="bag, folder of bags, or CSV file")
    add("--output", "-o", metavar="DIR", help="folder for the results")
    add("--force", action="store_true", help="replace results that are there")
    add("--validate", action="append", default=[], metavar="BAG", help="judge the model by this")
    add("--wheel", action="append", default=[], metavar="NAME", help="only this wheel")
    add("--model", default="auto", help="force a model instead of choosing one")
    add("--fix", action="append", default=[], metavar="NAME=VALUE", help="known parameter, in SI")
    add("--map", action="append", nargs="+", default=[], metavar="KEY=VALUE", help="see below")
    add("--mapping", metavar="FILE", help="the same as YAML file")
    add("--msg", action="append", default=[], metavar="FILE", help=".msg file of an unknown type")
    add("--topics", action="store_true", help="list what the bag offers, suggest a mapping")
    add("--what-next", action="store_true", help="propose the next recording")
    add("--accuracy", type=_share, default=0.01, help="wanted by --what-next; default 0.01")
    add("--quiet", "-q", action="store_true", help="print errors only")
    return made


def _share(text: str) -> float:
    """Return a relative accuracy; argparse turns the error into its own."""
    value = float(text)
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and 1")
    return value


def fixed_parameters(items: Sequence[str]) -> dict[str, float]:
    """Read ``--fix`` arguments."""
    fixed = {}
    for item in items:
        name, _, text = item.partition("=")
        if name not in UNITS:
            raise ParameterError(f"--fix {item}: {name!r} is none of {', '.join(UNITS)}")
        try:
            value = float(text)
        except ValueError:
            raise ParameterError(f"--fix {item}: {text!r} is not a number") from None
        if not 0 <= value < float("inf"):
            raise ParameterError(f"--fix {item}: must be zero or positive, in {UNITS[name]}")
        fixed[name] = value
    return fixed


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool.

    Parameters
    ----------
    argv : sequence of str or None
        Arguments; None takes those of the process.

    Returns
    -------
    int
        0 done, 1 the data do not support the answer, 2 wrong usage or unreadable input.
    """
    given = sys.argv[1:] if argv is None else list(argv)
    return run(parser(), partial(work, shlex.join((NAME, *given))), given)


def work(command: str, arguments: argparse.Namespace) -> int:
    """Do what the arguments say."""
    mapping = signal_map(arguments)
    if arguments.topics:
        return list_topics(arguments.bags, arguments.msg, NAME)
    if not arguments.output:
        raise ParameterError("--output DIR is missing: where shall the results go?")
    fixed = fixed_parameters(arguments.fix)
    paths = [Path(arguments.output) / name for name in OUTPUTS]
    check_free(paths, arguments.force)
    with progress(NAME, arguments.quiet) as say:
        say("reading")
        records = _read(arguments.bags, mapping, arguments.wheel)
        kept = _read(arguments.validate, mapping, list(records)) if arguments.validate else {}
        results = Results()
        for wheel in records:
            say(f"{wheel}: fitting")
            _identify(wheel, records[wheel], kept.get(wheel, []), arguments, fixed, results, say)
        if results.estimates:
            say("drawing the report")
            contents = _contents(results, arguments, command)
            write_together(dict(zip(paths, contents, strict=True)), arguments.force)
    return _tell(results, paths, arguments)


def signal_map(arguments: argparse.Namespace) -> bag.SignalMap | None:
    """Return the mapping that the arguments ask for."""
    items = [item for group in arguments.map for item in group]
    if items and arguments.mapping:
        raise ParameterError("--map and --mapping exclude each other; write all into the file")
    if arguments.mapping:
        loaded = bag.load(arguments.mapping)
        return replace(loaded, msg_files=(*loaded.msg_files, *arguments.msg))
    return bag.parse(items, arguments.msg) if items or arguments.msg else None


def _read(
    paths: Sequence[str], mapping: bag.SignalMap | None, wheels: Sequence[str]
) -> dict[str, list[Record]]:
    """Read the wheels that are asked for, or all."""
    found = bag.read_experiments(list(paths), mapping)
    for wheel in wheels:
        if wheel not in found:
            raise BagError(f"{', '.join(paths)}: has no wheel {wheel!r}; it has {', '.join(found)}")
    return {wheel: found[wheel] for wheel in wheels} if wheels else found


def _identify(
    wheel: str,
    records: Sequence[Record],
    kept: Sequence[Record],
    arguments: argparse.Namespace,
    fixed: Mapping[str, float],
    results: Results,
    say: Say,
) -> None:
    """Estimate one motor into the results; a refusal goes there too, with its reason."""
    try:
        found = estimate(
            records,
            arguments.model,
            fixed=fixed,
            validation=kept or None,
            progress=lambda text: say(f"{wheel}: {text}"),
        )
    except ParameterError:
        raise
    except SmpError as error:
        results.failures[wheel] = error
        return
    except np.linalg.LinAlgError as error:
        # One wheel's numerics must not take the others' results with them.
        results.failures[wheel] = InsufficientExcitationError(
            f"{records[0].source}: {wheel}: the estimate broke down ({error}); record a longer "
            "excitation with several frequencies, in both directions"
        )
        return
    results.estimates[wheel] = found
    notes = [note for record in (*records, *kept) for note in record.notes]
    results.notes[wheel] = list(dict.fromkeys(notes))
    fitted, held = (records, kept) if kept else split(records)
    curves: list[tuple[Record, Role]] = [(record, "estimation") for record in fitted]
    curves += [(record, "validation") for record in held]
    results.comparisons[wheel] = [_compare(found, record, role) for record, role in curves]


def _compare(found: Estimate, record: Record, role: Role) -> Comparison:
    measured, simulated = simulate(found, record)
    return Comparison(role, record.source, record.time, record.voltage, measured, simulated)


def _contents(results: Results, arguments: argparse.Namespace, command: str) -> list[str]:
    """Return the three files' texts, in the order of :data:`OUTPUTS`."""
    from smp_motor_ident.report.html import Report, render  # matplotlib takes half a second

    now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    provenance = {
        "Recordings": ", ".join(Path(path).name for path in arguments.bags),
        "Judged by": ", ".join(Path(path).name for path in arguments.validate)
        or "parts of the same recordings that were held out",
        "Command": command,
        "Date": now,
        "Versions": ", ".join(
            f"{name} {metadata.version(name)}" for name in ("smp_motor_control", "numpy", "numba")
        ),
    }
    failures = {wheel: str(error) for wheel, error in results.failures.items()}
    report = Report(results.estimates, results.comparisons, failures, results.notes, provenance)
    document = identification_document(results.estimates)
    head = [f"Identified {now} by {NAME} from {provenance['Recordings']}.", "SI, motor shaft."]
    return [
        json.dumps(document, indent=2, allow_nan=False) + "\n",
        motors_yaml(results.estimates, head),
        render(report),
    ]


def _tell(results: Results, paths: Sequence[Path], arguments: argparse.Namespace) -> int:
    """Print what came out; return the exit code."""
    if not arguments.quiet:
        out = console()
        for estimate in results.estimates.values():
            out.print(estimate_table(estimate))
            notes = results.notes[estimate.wheel]
            for text in estimate.warnings:
                out.print(
                    f"{'note' if text in notes else 'warning'}: {text}",
                    soft_wrap=True,
                    markup=False,
                )
            for text in estimate.advice:
                out.print(f"advice: {text}", soft_wrap=True)
            if arguments.what_next:
                out.print(
                    f"next: {what_next(estimate, arguments.accuracy).words}",
                    soft_wrap=True,
                    markup=False,
                )
            out.print()
        if results.estimates:
            out.print(f"written: {', '.join(str(path) for path in paths)}", soft_wrap=True)
    for error in results.failures.values():
        print(f"{NAME}: {error}", file=sys.stderr)
    return max((error.exit_code for error in results.failures.values()), default=0)


if __name__ == "__main__":
    raise SystemExit(main())
