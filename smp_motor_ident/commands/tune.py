"""tune: identification.json (or motors.yaml) in, gains for the four wheel nodes out."""

from __future__ import annotations

import argparse
import datetime
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from smp_motor_ident.bag.transport import TransportDelay, measure_delay
from smp_motor_ident.commands import applying, frame, relaying
from smp_motor_ident.errors import DesignError, ParameterError
from smp_motor_ident.report.document import check_free, read_identification, write_together
from smp_motor_ident.report.tuning_figures import tuning_svg
from smp_motor_ident.result import Estimate, Quantity
from smp_motor_ident.tune import METHODS, Design, Loop, WheelSet, compare, design_wheels, recommend
from smp_motor_ident.tune.curves import curves
from smp_motor_ident.tune.loop import SPEED_SOURCES
from smp_motor_ident.tune.writing import gains_document, gains_yaml, to_json

TARGETS = (
    "phase_margin",
    "maximum_sensitivity",
    "focus",
    "bandwidth",
    "structure",
    "closed_loop_time_constant",
    "natural_frequency",
    "damping",
    "relay_amplitude",
    "rule",
    "max_velocity",
    "max_acceleration",
    "transition_time",
)
DEFAULT_RATE = 200.0


def parser() -> argparse.ArgumentParser:
    """Return the parser of the tool's arguments.

    Returns
    -------
    argparse.ArgumentParser
    """
    p = frame.Parser(prog="tune", description="Design gains that hold on the loop that will run.")
    p.add_argument(
        "source", type=Path, nargs="?", help="identification.json, its folder, or motors.yaml"
    )
    p.add_argument(
        "--output", type=Path, help="parameter file to write; gains.json and a figure go beside it"
    )
    p.add_argument("--method", default="margin", help=", ".join(METHODS))
    p.add_argument("--compare", action="store_true", help="show every method; take the recommended")
    loop = p.add_argument_group("the loop that will run")
    loop.add_argument("--rate", type=float, help="steps per second [Hz]; else that of the bag")
    loop.add_argument(
        "--delay", type=float, help="measurement to voltage, beyond the hold [s]; else one sample"
    )
    loop.add_argument(
        "--bag", type=Path, help="measure both delays: a bag with motor_state and motor_command "
        "of the driving wheels",
    )  # fmt: skip
    loop.add_argument("--usual-delay", type=float, help="what it usually is [s]; else --delay")
    loop.add_argument("--speed-source", choices=SPEED_SOURCES, default="measured")
    loop.add_argument("--difference-window", type=int, default=1, help="[samples]")
    loop.add_argument("--gear-ratio", type=float, help="else as identified")
    loop.add_argument("--counts-per-revolution", type=float, help="else as identified")
    loop.add_argument("--supply", type=float, help="[V]; else as identified")
    aim = p.add_argument_group("what to aim at")
    aim.add_argument("--phase-margin", type=float, help="[deg], 60")
    aim.add_argument("--maximum-sensitivity", type=float, help="Ms, 1.4")
    aim.add_argument("--focus", choices=("balanced", "tracking", "load"))
    aim.add_argument("--bandwidth", type=float, help="crossover [rad/s]")
    aim.add_argument("--structure", choices=("pi", "pid"))
    aim.add_argument("--closed-loop-time-constant", type=float, help="[s], of simc and lambda")
    aim.add_argument("--natural-frequency", type=float, help="[rad/s], of pole_placement")
    aim.add_argument("--damping", type=float, help="of pole_placement, 0.8")
    aim.add_argument("--max-velocity", type=float, help="[rad/s, wheel]")
    aim.add_argument("--max-acceleration", type=float, help="[rad/s^2, wheel]")
    aim.add_argument("--transition-time", type=float, help="of a change of set-point [s]")
    p.add_argument("--sets", choices=("auto", "one", "each"), default="auto",
                   help="one set of gains for all wheels, or one each")  # fmt: skip
    p.add_argument(
        "--apply",
        action="store_true",
        help="set the gains in the running wheels, watch, take them back if a loop misbehaves",
    )
    p.add_argument(
        "--gains", type=Path, help="with --apply and without a source: gains of this file"
    )
    p.add_argument("--watch", type=float, default=3.0, help="trial after --apply [s]")
    relay = p.add_argument_group("relay feedback on a running wheel, without a model")
    relay.add_argument("--relay", metavar="WHEEL", help="make it oscillate, and tune from that")
    relay.add_argument("--relay-amplitude", type=float, help="[V]; a quarter of the supply")
    relay.add_argument("--relay-hysteresis", type=float, default=0.05, help="[rad/s, wheel]")
    relay.add_argument("--relay-seconds", type=float, default=4.0)
    relay.add_argument("--rule", choices=("tyreus_luyben", "ziegler_nichols"))
    p.add_argument("--force", action="store_true", help="replace files that exist")
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool.

    Parameters
    ----------
    argv : sequence of str or None
        Arguments; None takes those of the process.

    Returns
    -------
    int
        0 done, 1 no gains meet what was asked, 2 wrong usage or unreadable input.
    """
    return frame.run(parser(), _work, argv)


def _work(arguments: argparse.Namespace) -> int:
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
    files = _files(arguments)
    check_free(files, arguments.force)
    estimates = read_estimates(arguments.source)
    measured = {} if arguments.bag is None else measure_delay(arguments.bag)
    loops = {w: loop_for(one, arguments, measured.get(w)) for w, one in estimates.items()}
    told_delays = _tell_delays(loops, measured, arguments)
    print("".join(f"{line}\n" for line in told_delays), end="")
    targets = {n: getattr(arguments, n) for n in TARGETS if getattr(arguments, n) is not None}
    method = arguments.method
    with frame.progress("tune") as say:
        if arguments.compare:
            say("comparing the methods")
            method = _compare(estimates, loops, targets)
            targets = {k: v for k, v in targets.items() if k in _known(method)}
        say("designing")
        wheels = design_wheels(estimates, loops, method, arguments.sets, **targets)
    _show(wheels)
    if files:
        now = datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
        text = gains_yaml(
            wheels.designs, [*_provenance(wheels, arguments, estimates, now), *told_delays]
        )
        sources = sorted({s for e in estimates.values() for s in e.sources})
        told = {
            "date": now,
            "input": str(arguments.source),
            "sources": sources,
            "delays": told_delays,
        }
        document = to_json(gains_document(wheels.designs, told, wheels.reason))
        drawn = {w: curves(estimates[w], one) for w, one in wheels.designs.items()}
        figure = tuning_svg(drawn, METHODS[method].promise.sensitivity)
        write_together(dict(zip(files, (text, document, figure), strict=True)), arguments.force)
        print(f"written: {files[0]}, beside it {files[1].name} and {files[2].name}")
    if arguments.apply:
        return 0 if applying.apply(applying.from_designs(wheels.designs), arguments.watch) else 1
    return 0


def _apply_file(arguments: argparse.Namespace) -> int:
    """Set the gains of a file, as they are."""
    if arguments.source is not None or arguments.output is not None or not arguments.apply:
        raise ParameterError("--gains goes with --apply alone, without a source and --output")
    return 0 if applying.apply(applying.from_file(arguments.gains), arguments.watch) else 1


def _files(arguments: argparse.Namespace) -> list[Path]:
    output: Path | None = arguments.output
    if output is None:
        return []
    if output.suffix not in (".yaml", ".yml"):
        raise ParameterError(f"--output {output}: must end in .yaml, as ROS parameter files do")
    return [output, output.with_suffix(".json"), output.with_suffix(".svg")]


def read_estimates(source: Path) -> dict[str, Estimate]:
    """Read what is to be tuned.

    Parameters
    ----------
    source : Path
        ``identification.json``, the folder that holds it, or a motor file.

    Returns
    -------
    dict of str to Estimate
        By wheel; from a motor file without uncertainty.

    Raises
    ------
    BagError, ParameterError
        When the file cannot be read or is not what it should be.
    """
    if source.suffix not in (".yaml", ".yml"):
        return read_identification(source)
    from smp_motor_control.motor_file import load_motors
    from smp_motor_ident.record import Hardware

    estimates = {}
    for wheel, entry in load_motors(source).items():
        m = entry.parameters
        held = {
            "dc_gain": m.dc_gain,
            "time_constant": m.time_constant,
            "time_constant_product": m.time_constant_product,
            "static_voltage": m.static_voltage,
            "delay": entry.delay,
        }
        estimates[wheel] = Estimate(
            wheel=wheel,
            model="motor file",
            parameters={},
            combinations={name: Quantity(value, status="fixed") for name, value in held.items()},
            sources=(source.name,),
            hardware=Hardware(
                gear_ratio=entry.gearbox.ratio,
                counts_per_revolution=entry.encoder.counts_per_revolution,
                supply_voltage=entry.supply_voltage,
            ),
        )
    return estimates


def loop_for(
    estimate: Estimate, arguments: argparse.Namespace, measured: TransportDelay | None = None
) -> Loop:
    """Return the loop of one wheel: what the user says, else what the bag knew.

    Parameters
    ----------
    estimate : Estimate
        Its hardware and sample time are the defaults.
    arguments : argparse.Namespace
        Of the tool.
    measured : TransportDelay or None
        The loop's delay as a bag told it; what the user says goes before.

    Returns
    -------
    Loop

    Raises
    ------
    ParameterError
        When a value is impossible, or the supply is neither known nor given.
    """
    hardware = estimate.hardware
    supply = _first(arguments.supply, hardware.supply_voltage)
    if supply is None:
        raise ParameterError(
            f"{arguments.source}: {estimate.wheel}: the supply voltage is not known; give --supply"
        )
    if arguments.rate is not None and not arguments.rate > 0:
        raise ParameterError(f"--rate is {arguments.rate}; it must be positive")
    if arguments.rate is not None:
        sample_time = 1.0 / arguments.rate
    else:
        sample_time = estimate.sample_time or 1.0 / DEFAULT_RATE
    usual, longest = (None, None) if measured is None else measured.until_applied(sample_time)
    if arguments.delay is not None:
        usual = None  # it is the longest, which nothing measured may pass
    return Loop(
        sample_time=sample_time,
        delay=_first(arguments.delay, longest),
        usual_delay=_first(arguments.usual_delay, usual),
        gear_ratio=_first(arguments.gear_ratio, hardware.gear_ratio) or 0.0,
        counts_per_revolution=_first(
            arguments.counts_per_revolution, hardware.counts_per_revolution
        ),
        supply_voltage=supply,
        speed_source=arguments.speed_source,
        difference_window=arguments.difference_window,
    )


def _tell_delays(
    loops: Mapping[str, Loop],
    measured: Mapping[str, TransportDelay],
    arguments: argparse.Namespace,
) -> list[str]:
    """Return where the delays come from, in a line for each wheel, if a bag was to tell them."""
    lines = []
    for wheel, loop in loops.items() if arguments.bag is not None else ():
        if wheel not in measured:
            lines.append(f"{wheel}: {arguments.bag} tells no delay: taken as one sample")
            continue
        one = measured[wheel]
        lines.append(
            f"{wheel}: delay usually {1e3 * loop.expected_delay:.3g} ms, at most "
            f"{1e3 * loop.loop_delay:.3g} ms, from {one.answers} commands of {arguments.bag} that "
            f"arrived after {1e3 * one.usual:.3g} ms, 95 % within {1e3 * one.longest:.3g} ms"
            + (", and wait for the driver's next sample" if one.latched else "")
        )
    return lines


def _first(given: float | None, identified: float | None) -> float | None:
    return identified if given is None else given


def _known(method: str) -> tuple[str, ...]:
    return (*METHODS[method].targets, "max_velocity", "max_acceleration", "transition_time")


def _compare(
    estimates: Mapping[str, Estimate], loops: Mapping[str, Loop], targets: Mapping[str, Any]
) -> str:
    """Print the methods side by side for each wheel; return the one that most recommend."""
    votes: dict[str, int] = {}
    reason: dict[str, str] = {}
    for wheel, estimate in estimates.items():
        results = compare(estimate, loops[wheel], **targets)
        name, why = recommend(results)
        votes[name] = votes.get(name, 0) + 1
        reason.setdefault(name, why)
        print(f"\n{wheel}")
        print(_HEAD)
        for method, result in results.items():
            mark = "*" if method == name else " "
            print(f"{mark} {method:16s} {_row(result)}")
    chosen = max(votes, key=lambda n: votes[n])
    print(f"\n* recommended: {chosen}. {reason[chosen]}\n")
    return chosen


_HEAD = (
    f"  {'method':16s} {'p':>7} {'i':>7} {'d':>7} {'PM':>4} {'GM':>5} {'Ms':>5} {'settle':>7} "
    f"{'over':>5} {'load':>6} {'volts':>6} {'ripple':>6}"
)


def _row(result: Design | DesignError) -> str:
    if isinstance(result, DesignError):
        return str(result)
    g, m, f = result.gains, result.margins, result.performance
    return (
        f"{g.p:7.3f} {g.i:7.2f} {g.d:7.4f} {m.phase:4.0f} {m.gain:5.2f} {m.sensitivity:5.2f} "
        f"{1e3 * f.settling:5.0f}ms {f.overshoot:4.1f}% {f.load_integral:6.3f} "
        f"{f.peak_voltage:5.2f}V {1e3 * f.ripple:4.0f}mV"
    )


def _show(wheels: WheelSet) -> None:
    print(f"  {'wheel':16s}{_HEAD[18:]}")
    for wheel, design in wheels.designs.items():
        print(f"  {wheel:16s} {_row(design)}")
    print(wheels.reason)
    for wheel, design in wheels.designs.items():
        print(f"{wheel}: {design.reason}")
        for warning in design.warnings:
            print(f"{wheel}: warning: {warning}")


def _provenance(
    wheels: WheelSet, arguments: argparse.Namespace, estimates: Mapping[str, Estimate], now: str
) -> list[str]:
    lines = [
        f"Gains of the wheel nodes, designed {now} by tune from {arguments.source}.",
        "Units: wheel rad/s, volts, seconds; model.* at the motor shaft.",
        wheels.reason,
    ]
    for wheel, design in wheels.designs.items():
        sources = ", ".join(estimates[wheel].sources) or "unknown"
        lines.append(f"{wheel}: {estimates[wheel].model} model from {sources}")
        lines.append(f"  {design.reason}")
        lines.extend(f"  warning: {warning}" for warning in design.warnings)
    return lines


if __name__ == "__main__":
    sys.exit(main())
