# SPDX-License-Identifier: Apache-2.0
"""``tune``: design gains from identification.json or motors.yaml for wheel nodes or other loops."""

from functools import partial
from pathlib import Path
from typing import Any

from smp_motor_ident.cli import frame

# Names of modules' contents that load only after the arguments are parsed; a test compares them.
METHODS = (
    "margin", "pole_placement", "simc", "ziegler_nichols", "tyreus_luyben", "relay",
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
    "closed_loop_time_constant": dict(type=float, help="[s], of simc"),
    "natural_frequency": dict(type=float, help="[rad/s], of pole_placement"),
    "damping": dict(type=float, help="of pole_placement, 0.8"),
    "max_velocity": dict(type=float, help="[rad/s, wheel]"),
    "max_acceleration": dict(type=float, help="[rad/s^2, wheel]"),
    "transition_time": dict(type=float, help="of a change of set-point [s]"),
    "rule": dict(choices=("tyreus_luyben", "ziegler_nichols"), help="of --relay"),
}
"""Arguments for the targets of the design."""

LOOP: dict[str, dict[str, Any]] = {
    "rate": dict(type=float, help="steps per second [Hz]; else that of the bag"),
    "delay": dict(type=float, help="measurement to voltage, beyond the hold [s]; else one sample"),
    "bag": dict(
        type=Path,
        help="measure both delays: a bag with motor_state and motor_command of the driving wheels",
    ),
    "usual_delay": dict(type=float, help="usual delay [s]; default: --delay"),
    "speed_source": dict(
        choices=("auto", *SPEED_SOURCES), default="auto",
        help="auto compares the gains that each allows",
    ),
    "difference_window": dict(type=int, help="[samples]; else as identified"),
    "speed_noise": dict(type=float, help="of the reported speed, standard deviation "
                        "[rad/s, motor]; else as identified"),
    "angle_noise": dict(type=float, help="of an angle (not counts) whose difference is the speed, "
                        "standard deviation [rad, motor]; else as identified"),
    "gear_ratio": dict(type=float, help="else as identified"),
    "counts_per_revolution": dict(type=float, help="else as identified"),
    "supply": dict(type=float, help="[V]; else as identified"),
}  # fmt: skip

RUNNING: dict[str, dict[str, Any]] = {
    "apply": dict(
        action="store_true",
        help="set the gains in the running wheels, and restore the old ones if a loop misbehaves",
    ),
    "gains": dict(type=Path, help="with --apply and without a source: gains of this file"),
    "watch": dict(type=float, default=3.0, help="trial after --apply [s]"),
    "relay": dict(metavar="WHEEL", help="tune by relay feedback, without a model"),
    "relay_amplitude": dict(type=float, help="[V]; a quarter of the supply"),
    "relay_hysteresis": dict(type=float, default=0.05, help="[rad/s, wheel]"),
    "relay_seconds": dict(type=float, default=4.0),
}
GROUPS = {"the loop": LOOP, "targets": AIMS, "running wheels": RUNNING}

TARGETS = (*AIMS, "relay_amplitude", "accept_unreliable")


def parser() -> frame.Parser:
    """Return the parser of the tool's arguments."""
    about = "Design gains that keep their margins on the loop that will run."
    p = frame.Parser(prog="tune", description=about, epilog=frame.OF_ROS)
    add = p.add_argument
    add("source", type=Path, nargs="?", help="identification.json, its folder, or motors.yaml")
    add(
        "--output",
        type=Path,
        help="parameter file to write; gains.json and a figure go to the same folder",
    )
    add(
        "--export", choices=FORMATS, metavar="FORMAT",
        help="gains for a loop that others run, at its usual rate: " + ", ".join(FORMATS),
    )  # fmt: skip
    add("--method", default="margin", help=", ".join(METHODS))
    add("--compare", action="store_true", help="show every method; take the recommended")
    add(
        "--alone", action="store_true",
        help="each wheel as fast as its own voltage allows, instead of all together",
    )  # fmt: skip
    add("--sets", choices=("auto", "one", "each"), default="auto",
        help="one set of gains for all wheels, or one each")  # fmt: skip
    add(
        "--accept-unreliable", action="store_true", default=None,
        help="design on an unreliable identification, with its full uncertainty",
    )  # fmt: skip
    add("--force", action="store_true", help="replace existing files")
    for title, arguments in GROUPS.items():
        group = p.add_argument_group(title)
        for name, options in arguments.items():
            group.add_argument("--" + name.replace("_", "-"), **options)
    return p


main = partial(frame.run, parser, "tuning")


if __name__ == "__main__":
    raise SystemExit(main())
