# SPDX-License-Identifier: Apache-2.0
"""``tune``: design gains from identification.json or motors.yaml for wheel nodes or other loops."""

from functools import partial
from pathlib import Path
from typing import Any

from smp_motor_ident.cli import frame

# Names of modules' contents that load only after the arguments are parsed; a test compares them.
METHODS = ("margin", "simc", "ziegler_nichols", "tyreus_luyben")
FORMATS = ("ros2_controllers", "linorobot2", "ros_arduino_bridge", "arduino_pid")
SPEED_SOURCES = ("measured", "difference", "observer")

# Each row: name, type or choices, unit, help, and a default other than None
LOOP = (
    ("rate", float, "HZ", "sampling rate of the loop"),
    ("delay", float, "S",
     "longest delay from measurement to voltage, without the hold; default: one sample"),
    ("bag", Path, None,
     "measure both delays in a bag with motor_state and motor_command of driving wheels"),
    ("usual_delay", float, "S", "usual delay; default: --delay"),
    ("speed_source", ("auto", *SPEED_SOURCES), None,
     "default auto: the source that allows the largest gains", "auto"),
    ("difference_window", int, "SAMPLES", "samples over which counts are differenced"),
    ("speed_noise", float, "RAD/S", "standard deviation of the reported speed, at the motor shaft"),
    ("angle_noise", float, "RAD",
     "standard deviation of an angle that is differenced, at the motor shaft"),
    ("gear_ratio", float, "RATIO", "motor revolutions per wheel revolution"),
    ("counts_per_revolution", float, "COUNTS", "counts per motor revolution"),
    ("supply", float, "V", "supply voltage"),
)  # fmt: skip
AIMS = (
    ("phase_margin", float, "DEG", "required phase margin; default of the method margin: 60"),
    ("maximum_sensitivity", float, "MS",
     "largest sensitivity peak Ms; default of the method margin: 1.4"),
    ("focus", ("balanced", "tracking", "load"), None,
     "for the method margin: set-points, loads or both (default)"),
    ("bandwidth", float, "RAD/S", "crossover frequency of the method margin"),
    ("structure", ("pi", "pid"), None, "of the controller; default: the better one"),
    ("closed_loop_time_constant", float, "S", "of the method simc"),
    ("max_velocity", float, "RAD/S", "limit of the set-point at the wheel"),
    ("max_acceleration", float, "RAD/S2", "limit of the reference at the wheel"),
    ("transition_time", float, "S", "duration of a change of set-point; default: the shortest"),
)  # fmt: skip
RUNNING = (
    ("gains", Path, "FILE", "with --apply, instead of a source: parameter file to apply"),
    ("watch", float, "S", "length of the trial; default 3", 3.0),
    ("relay", str, "WHEEL", "tune this wheel by relay feedback, without a model"),
    ("relay_amplitude", float, "V", "of the output; default: a quarter of the supply"),
    ("relay_hysteresis", float, "RAD/S", "of the speed at the wheel; default 0.05", 0.05),
    ("relay_seconds", float, "S", "length of the test; default 4", 4.0),
    ("rule", ("tyreus_luyben", "ziegler_nichols"), None, "rule of --relay"),
)
GROUPS: dict[str, tuple[tuple[Any, ...], ...]] = {
    "the loop (default: as recorded or identified)": LOOP,
    "targets": AIMS,
    "running wheels": RUNNING,
}
TARGETS = (*(row[0] for row in AIMS), "accept_unreliable")


def parser() -> frame.Parser:
    """Return the parser of the tool's arguments."""
    about = (
        "Design the speed controllers of identified motors for the sampled loop that will run. "
        "Write a parameter file for wheel_pid, or gains for another controller."
    )
    p = frame.Parser(prog="tune", description=about, epilog=frame.ROS_HELP)
    add = p.add_argument
    add("source", type=Path, nargs="?", help="identification.json, its folder, or motors.yaml")
    add("--output", type=Path, metavar="FILE",
        help="parameter file to write (.yaml), next to gains.json and a figure")  # fmt: skip
    add("--export", choices=FORMATS, metavar="FORMAT",
        help="gains for another controller, at its usual rate: " + ", ".join(FORMATS))  # fmt: skip
    add("--method", default="margin", help=f"{', '.join(METHODS)}; default margin")
    add("--compare", action="store_true",
        help="print the designs of all methods and use the recommended one")  # fmt: skip
    add("--alone", action="store_true",
        help="plan each wheel as fast as its voltage allows, instead of all together")  # fmt: skip
    add("--sets", choices=("auto", "one", "each"), default="auto",
        help="one set of gains for all wheels, or one each; auto: one if it suffices")  # fmt: skip
    add("--accept-unreliable", action="store_true", default=None,
        help="design on an unreliable identification, with a larger uncertainty")  # fmt: skip
    add("--force", action="store_true", help="replace existing files")
    for title, rows in GROUPS.items():
        group = p.add_argument_group(title)
        for name, kind, unit, text, *default in rows:
            how = {"choices": kind} if isinstance(kind, tuple) else {"type": kind, "metavar": unit}
            options: dict[str, Any] = {
                **how,
                "help": text,
                "default": default[0] if default else None,
            }
            group.add_argument("--" + name.replace("_", "-"), **options)
    group.add_argument("--apply", action="store_true", help="set the gains in the running wheels, "
        "and restore the old ones if a loop misbehaves")  # fmt: skip
    return p


main = partial(frame.run, parser, "tuning")


if __name__ == "__main__":
    raise SystemExit(main())
