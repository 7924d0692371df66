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
    "ros2_controllers", "linorobot2", "ros_arduino_bridge", "arduino_pid", "wpilib",
)  # fmt: skip
SPEED_SOURCES = ("measured", "difference", "observer")

AIMS: dict[str, dict[str, Any]] = {
    "phase_margin": dict(
        type=float, metavar="DEG", help="required phase margin; default of the method margin: 60"
    ),
    "maximum_sensitivity": dict(
        type=float,
        metavar="MS",
        help="largest sensitivity peak Ms; default of the method margin: 1.4",
    ),
    "focus": dict(
        choices=("balanced", "tracking", "load"),
        help="what the method margin favours: set-points, loads or both (default)",
    ),
    "bandwidth": dict(type=float, metavar="RAD/S", help="crossover frequency of the method margin"),
    "structure": dict(choices=("pi", "pid"), help="of the controller; default: the better one"),
    "closed_loop_time_constant": dict(type=float, metavar="S", help="of the method simc"),
    "natural_frequency": dict(
        type=float, metavar="RAD/S", help="of the method pole_placement; default: the highest"
    ),
    "damping": dict(type=float, metavar="RATIO", help="of the method pole_placement; default 0.8"),
    "max_velocity": dict(type=float, metavar="RAD/S", help="limit of the set-point at the wheel"),
    "max_acceleration": dict(
        type=float, metavar="RAD/S2", help="limit of the reference at the wheel"
    ),
    "transition_time": dict(
        type=float, metavar="S", help="duration of a change of set-point; default: the shortest"
    ),
    "rule": dict(choices=("tyreus_luyben", "ziegler_nichols"), help="rule of --relay"),
}
"""Arguments for the targets of the design."""

LOOP: dict[str, dict[str, Any]] = {
    "rate": dict(type=float, metavar="HZ", help="sampling rate of the loop"),
    "delay": dict(
        type=float, metavar="S",
        help="longest delay from measurement to voltage, without the hold; default: one sample",
    ),
    "bag": dict(
        type=Path,
        help="measure both delays in a bag with motor_state and motor_command of driving wheels",
    ),
    "usual_delay": dict(type=float, metavar="S", help="usual delay; default: --delay"),
    "speed_source": dict(
        choices=("auto", *SPEED_SOURCES), default="auto",
        help="default auto: the source that allows the largest gains",
    ),
    "difference_window": dict(
        type=int, metavar="SAMPLES", help="samples over which counts are differenced"
    ),
    "speed_noise": dict(type=float, metavar="RAD/S",
                        help="standard deviation of the reported speed, at the motor shaft"),
    "angle_noise": dict(type=float, metavar="RAD",
                        help="standard deviation of an angle that is differenced, at the motor "
                        "shaft"),
    "gear_ratio": dict(type=float, metavar="RATIO", help="motor revolutions per wheel revolution"),
    "counts_per_revolution": dict(type=float, metavar="COUNTS", help="counts per motor revolution"),
    "supply": dict(type=float, metavar="V", help="supply voltage"),
}  # fmt: skip

RUNNING: dict[str, dict[str, Any]] = {
    "apply": dict(
        action="store_true",
        help="set the gains in the running wheels, and restore the old ones if a loop misbehaves",
    ),
    "gains": dict(
        type=Path, metavar="FILE", help="with --apply, instead of a source: parameter file to apply"
    ),
    "watch": dict(type=float, default=3.0, metavar="S", help="length of the trial; default 3"),
    "relay": dict(metavar="WHEEL", help="tune this wheel by relay feedback, without a model"),
    "relay_amplitude": dict(
        type=float, metavar="V", help="of the output; default: a quarter of the supply"
    ),
    "relay_hysteresis": dict(
        type=float, default=0.05, metavar="RAD/S", help="of the speed at the wheel; default 0.05"
    ),
    "relay_seconds": dict(
        type=float, default=4.0, metavar="S", help="length of the test; default 4"
    ),
}
GROUPS = {
    "the loop (default: as recorded or identified)": LOOP,
    "targets": AIMS,
    "running wheels": RUNNING,
}

TARGETS = (*AIMS, "relay_amplitude", "accept_unreliable")


def parser() -> frame.Parser:
    """Return the parser of the tool's arguments."""
    about = (
        "Design the speed controllers of identified motors for the sampled loop that will run. "
        "Write a parameter file for wheel_pid, or gains for another controller."
    )
    p = frame.Parser(prog="tune", description=about, epilog=frame.OF_ROS)
    add = p.add_argument
    add("source", type=Path, nargs="?", help="identification.json, its folder, or motors.yaml")
    add(
        "--output",
        type=Path,
        metavar="FILE",
        help="parameter file to write (.yaml); gains.json and a figure go to the same folder",
    )
    add(
        "--export", choices=FORMATS, metavar="FORMAT",
        help="gains for another controller, at its usual rate: " + ", ".join(FORMATS),
    )  # fmt: skip
    add("--method", default="margin", help=f"{', '.join(METHODS)}; default margin")
    add(
        "--compare",
        action="store_true",
        help="print the designs of all methods and use the recommended one",
    )
    add(
        "--alone", action="store_true",
        help="plan each wheel as fast as its voltage allows, instead of all together",
    )  # fmt: skip
    add("--sets", choices=("auto", "one", "each"), default="auto",
        help="one set of gains for all wheels, or one each; auto: one if it suffices")  # fmt: skip
    add(
        "--accept-unreliable", action="store_true", default=None,
        help="design on an unreliable identification, with a larger uncertainty",
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
