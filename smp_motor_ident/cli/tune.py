"""``tune``: identification.json (or motors.yaml) in, gains for wheel nodes or other loops out."""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from smp_motor_ident.cli import frame

# Names of what is loaded only after the arguments are understood; a test holds them to it.
METHODS = (
    "margin", "optimise", "pole_placement", "simc", "lambda", "amigo", "ziegler_nichols",
    "tyreus_luyben", "relay",
)  # fmt: skip
FORMATS = (
    "ros2_controllers", "linorobot2", "ros_arduino_bridge", "arduino_pid", "roboclaw", "wpilib",
)  # fmt: skip
SPEED_SOURCES = ("measured", "difference", "observer")

AIMS: dict[str, dict[str, Any]] = {
    "phase_margin": dict(type=float, help="[deg], 60"),
    "maximum_sensitivity": dict(type=float, help="Ms, 1.4"),
    "focus": dict(choices=("balanced", "tracking", "load")),
    "bandwidth": dict(type=float, help="crossover [rad/s]"),
    "structure": dict(choices=("pi", "pid")),
    "closed_loop_time_constant": dict(type=float, help="[s], of simc and lambda"),
    "natural_frequency": dict(type=float, help="[rad/s], of pole_placement"),
    "damping": dict(type=float, help="of pole_placement, 0.8"),
    "max_velocity": dict(type=float, help="[rad/s, wheel]"),
    "max_acceleration": dict(type=float, help="[rad/s^2, wheel]"),
    "transition_time": dict(type=float, help="of a change of set-point [s]"),
    "rule": dict(choices=("tyreus_luyben", "ziegler_nichols"), help="of --relay"),
}
"""Arguments that say what to aim at, each a target of the design."""

TARGETS = (*AIMS, "relay_amplitude", "accept_unreliable")


def parser() -> frame.Parser:
    """Return the parser of the tool's arguments."""
    p = frame.Parser(
        prog="tune",
        description="Design gains that hold on the loop that will run.",
        epilog=frame.OF_ROS,
    )
    p.add_argument(
        "source", type=Path, nargs="?", help="identification.json, its folder, or motors.yaml"
    )
    p.add_argument(
        "--output", type=Path, help="parameter file to write; gains.json and a figure go beside it"
    )
    p.add_argument(
        "--export", choices=FORMATS, metavar="FORMAT",
        help="gains for a loop that others run, at its usual rate: " + ", ".join(FORMATS),
    )  # fmt: skip
    p.add_argument("--method", default="margin", help=", ".join(METHODS))
    p.add_argument("--compare", action="store_true", help="show every method; take the recommended")
    p.add_argument(
        "--alone", action="store_true",
        help="each wheel as fast as its own voltage allows, instead of all together",
    )  # fmt: skip
    p.add_argument("--sets", choices=("auto", "one", "each"), default="auto",
                   help="one set of gains for all wheels, or one each")  # fmt: skip
    p.add_argument(
        "--accept-unreliable", action="store_true", default=None,
        help="design on an identification that calls itself unreliable, as wide as it leaves",
    )  # fmt: skip
    p.add_argument("--force", action="store_true", help="replace files that exist")
    _add_loop(p.add_argument_group("the loop that will run"))
    aims = p.add_argument_group("what to aim at")
    for name, options in AIMS.items():
        aims.add_argument("--" + name.replace("_", "-"), **options)
    _add_running(p.add_argument_group("wheels that run"))
    return p


def _add_loop(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--rate", type=float, help="steps per second [Hz]; else that of the bag")
    group.add_argument(
        "--delay", type=float, help="measurement to voltage, beyond the hold [s]; else one sample"
    )
    group.add_argument(
        "--bag", type=Path, help="measure both delays: a bag with motor_state and motor_command "
        "of the driving wheels",
    )  # fmt: skip
    group.add_argument("--usual-delay", type=float, help="what it usually is [s]; else --delay")
    group.add_argument(
        "--speed-source", choices=("auto", *SPEED_SOURCES), default="auto",
        help="auto compares what each allows, and says why",
    )  # fmt: skip
    group.add_argument("--difference-window", type=int, help="[samples]; else as identified")
    group.add_argument("--speed-noise", type=float,
                       help="of the reported speed, standard deviation [rad/s, motor]; "
                       "else as identified")  # fmt: skip
    group.add_argument("--angle-noise", type=float,
                       help="of the angle that the speed is made from, beside counts, standard "
                       "deviation [rad, motor]; else as identified")  # fmt: skip
    group.add_argument("--gear-ratio", type=float, help="else as identified")
    group.add_argument("--counts-per-revolution", type=float, help="else as identified")
    group.add_argument("--supply", type=float, help="[V]; else as identified")


def _add_running(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--apply",
        action="store_true",
        help="set the gains in the running wheels, watch, take them back if a loop misbehaves",
    )
    group.add_argument(
        "--gains", type=Path, help="with --apply and without a source: gains of this file"
    )
    group.add_argument("--watch", type=float, default=3.0, help="trial after --apply [s]")
    group.add_argument("--relay", metavar="WHEEL",
                       help="make it oscillate, and tune from that, without a model")  # fmt: skip
    group.add_argument("--relay-amplitude", type=float, help="[V]; a quarter of the supply")
    group.add_argument("--relay-hysteresis", type=float, default=0.05, help="[rad/s, wheel]")
    group.add_argument("--relay-seconds", type=float, default=4.0)


main = partial(frame.run, parser, "tuning")


if __name__ == "__main__":
    raise SystemExit(main())
