# SPDX-License-Identifier: Apache-2.0
"""Run ``tune``: build loops from the arguments, design gains, report them."""

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence, Sized
from pathlib import Path
from typing import Any

from smp_motor_control.errors import printable
from smp_motor_control.motor.file import load_motors
from smp_motor_control.motor.parameters import COMBINATIONS
from smp_motor_control.parameter_file import flatten
from smp_motor_ident.bag.transport import TransportDelay, measure_delay
from smp_motor_ident.cli import applying, frame, relaying, tune
from smp_motor_ident.errors import DesignError, ParameterError
from smp_motor_ident.record import Hardware
from smp_motor_ident.report.document import check_free, now, read_identification, write_together
from smp_motor_ident.report.tuning_page import tuning_svg
from smp_motor_ident.result import Estimate, Quantity, to_json
from smp_motor_ident.tune import METHODS, Design, Loop, case, compare, design_wheels, recommend
from smp_motor_ident.tune.curves import curves
from smp_motor_ident.tune.exports import FORMATS, export
from smp_motor_ident.tune.source import choose_source
from smp_motor_ident.tune.wheels import WheelSet
from smp_motor_ident.tune.writing import describe_slow_loop, gains_document, gains_yaml, parameters

DEFAULT_RATE = 200.0  # steps per second where neither the user nor the identification says [Hz]
SOURCES_S, COMPARISON_S, DESIGN_S = 1.0, 3.0, 2.0
"""Time per wheel on one core [s]: comparing speed sources, comparing methods, one design."""


def work(arguments: argparse.Namespace) -> int:
    """Tune, export or apply, according to the arguments; return the exit code."""
    if arguments.relay is not None:
        return relaying.tune_by_relay(arguments, _files(arguments)[:1])
    if arguments.gains is not None:
        return _apply_file(arguments)
    if arguments.source is None:
        raise ParameterError("nothing to tune; give identification.json, its folder or motors.yaml")
    if arguments.method not in METHODS:
        raise ParameterError(
            f"--method is {arguments.method!r}; it must be one of {', '.join(METHODS)}"
        )
    if arguments.export is not None:
        return _export(arguments)
    files = _files(arguments)
    check_free(files, arguments.force)
    estimates = read_estimates(arguments.source)
    wheels, reasons = design_together(estimates, arguments)
    print_designs(wheels)
    if files:
        write(files, wheels, estimates, arguments, reasons)
    if arguments.apply:
        gains = {wheel: flatten(parameters(design)) for wheel, design in wheels.designs.items()}
        return applying.apply(gains, arguments)
    return 0


def loop_for(
    estimate: Estimate, arguments: argparse.Namespace, measured: TransportDelay | None = None
) -> Loop:
    """Return the loop of one wheel from the user's arguments, else from the bag."""
    hardware, counts = estimate.hardware, estimate.hardware.counts_per_revolution
    supply = _first(arguments.supply, hardware.supply_voltage)
    if supply is None:
        raise ParameterError(
            f"{arguments.source}: {estimate.wheel}: the supply voltage is not known; give --supply"
        )
    if arguments.rate is not None and not arguments.rate > 0:
        raise ParameterError(f"--rate is {arguments.rate}; it must be positive")
    usual_time = estimate.sample_time or 1.0 / DEFAULT_RATE
    sample_time = usual_time if arguments.rate is None else 1.0 / arguments.rate
    window = arguments.difference_window
    # The averaging of a recorded speed was identified.
    usual_window = int(arguments.speed_source == "difference" or not estimate.speed_noise)
    usual, longest = (None, None) if measured is None else measured.until_applied(sample_time)
    if arguments.delay is not None:
        usual = None  # a given delay is an upper limit
    return Loop(
        sample_time=sample_time,
        delay=_first(arguments.delay, longest),
        usual_delay=_first(arguments.usual_delay, usual),
        gear_ratio=_first(arguments.gear_ratio, hardware.gear_ratio) or 0.0,
        counts_per_revolution=_first(arguments.counts_per_revolution, counts),
        supply_voltage=supply,
        speed_source="measured" if arguments.speed_source == "auto" else arguments.speed_source,
        difference_window=usual_window if window is None else window,
        speed_noise=_first(arguments.speed_noise, estimate.speed_noise) or 0.0,
        speed_step=estimate.speed_step,
        angle_noise=_first(arguments.angle_noise, estimate.angle_noise) or 0.0,
        averaging_given=window is not None,
    )


def _first(given: float | None, identified: float | None) -> float | None:
    return identified if given is None else given


def _targets(arguments: argparse.Namespace) -> dict[str, Any]:
    return {n: getattr(arguments, n) for n in tune.TARGETS if getattr(arguments, n) is not None}


def design_together(
    estimates: Mapping[str, Estimate], arguments: argparse.Namespace
) -> tuple[WheelSet, dict[str, list[str]]]:
    """Return the designs, and the reasons for the delays and sources of speed that they assume."""
    measured = {} if arguments.bag is None else measure_delay(arguments.bag)
    loops = {w: loop_for(one, arguments, measured.get(w)) for w, one in estimates.items()}
    reasons = {"delays": describe_delays(loops, measured, arguments), "speed_sources": []}
    print("".join(f"{line}\n" for line in reasons["delays"]), end="")
    targets = _targets(arguments)
    method = arguments.method
    with frame.progress("tune") as say:
        if arguments.speed_source == "auto":
            say(_announce("comparing the sources of speed", SOURCES_S, estimates))
            loops, reasons["speed_sources"] = choose_sources(estimates, loops, targets)
        if arguments.compare:
            say(_announce("comparing the methods", COMPARISON_S, estimates))
            method = _compare(estimates, loops, targets)
            known = (*METHODS[method].targets, *case.COMMON_TARGETS)
            targets = {k: v for k, v in targets.items() if k in known}
        say(_announce("designing", DESIGN_S, estimates))
        wheels = design_wheels(
            estimates, loops, method, arguments.sets, together=not arguments.alone, **targets
        )
    print("".join(f"{line}\n" for line in reasons["speed_sources"]), end="")
    return wheels, reasons


def _announce(text: str, seconds: float, wheels: Sized) -> str:
    """Return the text of a step with its duration."""
    return f"{text}, which takes about {seconds * len(wheels):.0f} s"


def write(
    files: Sequence[Path],
    wheels: WheelSet,
    estimates: Mapping[str, Estimate],
    arguments: argparse.Namespace,
    reasons: Mapping[str, list[str]],
) -> None:
    """Write parameters, document and figure, all or none."""
    date = now()
    heading = provenance(wheels, arguments, estimates, date)
    heading += [line for lines in reasons.values() for line in lines]
    sources = sorted({s for e in estimates.values() for s in e.sources})
    source = printable(str(arguments.source))
    origin = {"date": date, "input": source, "sources": sources, **reasons}
    text = gains_yaml(wheels.designs, heading)
    document = to_json(gains_document(wheels.designs, origin, wheels.reason))
    drawn = {w: curves(estimates[w], one) for w, one in wheels.designs.items()}
    method = next(iter(wheels.designs.values())).method
    figure = tuning_svg(drawn, METHODS[method].required.sensitivity)
    write_together(dict(zip(files, (text, document, figure), strict=True)), arguments.force)
    print(f"written: {files[0]}, and with it {files[1].name} and {files[2].name}")


def choose_sources(
    estimates: Mapping[str, Estimate], loops: Mapping[str, Loop], targets: Mapping[str, Any]
) -> tuple[dict[str, Loop], list[str]]:
    """Return the loops with the speed source of each wheel, and a line of reasons for each."""
    known = ("phase_margin", "maximum_sensitivity", "focus", "structure", "accept_unreliable")
    margins = {name: value for name, value in targets.items() if name in known}
    chosen, lines = {}, []
    for wheel, estimate in estimates.items():
        chosen[wheel], why = choose_source(estimate, loops[wheel], **margins)
        lines.append(f"{wheel}: speed from {why}")
    return chosen, lines


def _export(arguments: argparse.Namespace) -> int:
    """Write or print gains for another loop."""
    target, output = FORMATS[arguments.export], arguments.output
    if arguments.apply or arguments.compare:
        raise ParameterError("--export excludes --apply and --compare; leave one out")
    if output is not None:
        check_free([output], arguments.force)
    arguments.rate = arguments.rate or target.rate
    arguments.speed_source = "difference" if target.counts else "measured"
    arguments.difference_window = arguments.difference_window or (1 if target.counts else None)
    estimates = read_estimates(arguments.source)
    loops = {wheel: loop_for(one, arguments) for wheel, one in estimates.items()}
    targets = _targets(arguments)
    with frame.progress("tune") as say:
        say(_announce(f"designing for {target.title}", DESIGN_S, estimates))
        text, _ = export(arguments.export, estimates, loops, **targets)
    if output is None:
        print(text, end="")
    else:
        write_together({output: text}, arguments.force)
        print(f"written: {output}")
    return 0


def _apply_file(arguments: argparse.Namespace) -> int:
    """Set the gains of a parameter file in the running wheels, unchanged."""
    if arguments.source is not None or arguments.output is not None or not arguments.apply:
        raise ParameterError("--gains needs --apply; leave out source and --output")
    return applying.apply(applying.from_file(arguments.gains), arguments)


def _files(arguments: argparse.Namespace) -> list[Path]:
    output: Path | None = arguments.output
    if output is None:
        return []
    if output.suffix not in (".yaml", ".yml"):
        raise ParameterError(f"--output {output}: must end in .yaml, as ROS parameter files do")
    return [output, output.with_suffix(".json"), output.with_suffix(".svg")]


def read_estimates(source: Path) -> dict[str, Estimate]:
    """Read the motors to design for."""
    if source.suffix not in (".yaml", ".yml"):
        return read_identification(source)
    estimates = {}
    for wheel, entry in load_motors(source).items():
        held = {name: float(getattr(entry.parameters, name)) for name in COMBINATIONS}
        held["delay"] = entry.delay
        counts = entry.encoder.counts_per_revolution
        hardware = Hardware(entry.gearbox.ratio, counts, supply_voltage=entry.supply_voltage)
        estimates[wheel] = Estimate(
            wheel=wheel,
            model="motor file",
            parameters={},
            combinations={name: Quantity(value, status="fixed") for name, value in held.items()},
            sources=(source.name,),
            hardware=hardware,
        )
    return estimates


def _compare(
    estimates: Mapping[str, Estimate], loops: Mapping[str, Loop], targets: Mapping[str, Any]
) -> str:
    """Print the methods side by side for each wheel; return the one recommended most often."""
    votes: Counter[str] = Counter()
    reason: dict[str, str] = {}
    for wheel, estimate in estimates.items():
        results = compare(estimate, loops[wheel], **targets)
        name, why = recommend(results)
        votes[name] += 1
        reason.setdefault(name, why)
        print(f"\n{wheel}\n{TABLE_HEAD}")
        for method, result in results.items():
            mark = "*" if method == name else " "
            print(f"{mark} {method:16s} {format_design(result)}")
    chosen = votes.most_common(1)[0][0]
    print(f"\n* recommended: {chosen}. {reason[chosen]}\n")
    return chosen


def describe_delays(
    loops: Mapping[str, Loop], measured: Mapping[str, TransportDelay], arguments: argparse.Namespace
) -> list[str]:
    """Return the sources of delays measured from a bag, in a line for each wheel."""
    lines = []
    for wheel, loop in loops.items() if arguments.bag is not None else ():
        if wheel not in measured:
            lines.append(f"{wheel}: {arguments.bag} has no delay data; one sample is assumed")
            continue
        one = measured[wheel]
        lines.append(
            f"{wheel}: delay usually {1e3 * loop.expected_delay:.3g} ms, at most "
            f"{1e3 * loop.loop_delay:.3g} ms, from {one.answers} commands of {arguments.bag} that "
            f"arrived after {1e3 * one.usual:.3g} ms, 95 % within {1e3 * one.longest:.3g} ms"
            + (", and wait for the driver's next sample" if one.latched else "")
        )
    return lines


TABLE_HEAD = (
    f"  {'method':16s} {'p':>8} {'i':>8} {'d':>8} {'PM':>4} {'GM':>6} {'Ms':>5} {'settle':>8} "
    f"{'over':>6} {'load':>8} {'volts':>7} {'noise':>7}"
)
"""Head of a table of designs."""


def format_design(result: Design | DesignError) -> str:
    """Return a design as a row under :data:`TABLE_HEAD`."""
    if isinstance(result, DesignError):
        return str(result)
    g, m, f = result.gains, result.margins, result.performance
    return (
        f"{g.p:8.3g} {g.i:8.3g} {g.d:8.3g} {m.phase:4.0f} {m.gain:6.3g} {m.sensitivity:5.2f} "
        f"{1e3 * f.settling:5.0f} ms {f.overshoot:4.1f} % {f.load_integral:8.3g} "
        f"{f.peak_voltage:5.2f} V {1e3 * f.control_noise:4.0f} mV"
    )


def print_designs(wheels: WheelSet) -> None:
    """Print the designs of all wheels, and the reasons for them."""
    print(f"  {'wheel':16s}{TABLE_HEAD[18:]}")
    for wheel, design in wheels.designs.items():
        print(f"  {wheel:16s} {format_design(design)}")
    print(wheels.reason)
    for wheel, design in wheels.designs.items():
        print("".join(f"{wheel}: {line}\n" for line in describe_design(design)), end="")


def describe_design(design: Design) -> list[str]:
    """Return settling, reason and warnings of a design."""
    warnings = (f"warning: {one}" for one in (*design.warnings, *describe_slow_loop(design)))
    return [design.settling.describe(), design.reason, *warnings]


def provenance(
    wheels: WheelSet, arguments: argparse.Namespace, estimates: Mapping[str, Estimate], date: str
) -> list[str]:
    """Return the provenance of gains, as lines for the head of their file."""
    lines = [
        f"Gains of the wheel nodes, designed {date} by tune from {arguments.source}.",
        "Units: wheel rad/s, volts, seconds; model.* at the motor shaft.",
        wheels.reason,
    ]
    for wheel, design in wheels.designs.items():
        sources = ", ".join(estimates[wheel].sources) or "unknown"
        lines.append(f"{wheel}: {estimates[wheel].model} model from {sources}")
        lines += [f"  {line}" for line in describe_design(design)]
    return lines
