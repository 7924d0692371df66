# SPDX-License-Identifier: Apache-2.0
"""``identify``: identify motors from recordings, each value with its uncertainty."""

import argparse
from functools import partial

from smp_motor_ident.cli.frame import Parser, number, run

NAME = "identify"

DESCRIPTION = """\
Identify the DC motors in one or more recordings. Write DIR/identification.json (values with their
uncertainty), DIR/motors.yaml (a parameter file for motor_plant) and DIR/report.html (charts and
findings, in one file). Recordings are rosbag2 or ROS 1 bags, CSV, Excel, MATLAB, JSON and WPILib
files with a voltage or PWM, and a speed, angle or encoder count.
"""
EPILOG = """\
examples:
  identify drive_bag --output result
  identify monday tuesday --validate wednesday --fix resistance=12.9 --output result
  identify --topics robot_bag
  identify robot_bag --output result --map voltage=/pwm.data*12/255 \\
           --map velocity=/joint_states.velocity[left_wheel_joint]
  identify log.csv --output result --map time=t voltage=u velocity=y:deg/s

--map takes [WHEEL.]SIGNAL=SOURCE[*SCALE][+OFFSET][:UNIT], with the signals voltage, velocity,
position, count, current, supply, direction and time, and properties such as gear_ratio=30,
counts_per_revolution=48, supply_voltage=12 and pwm_full_scale=255. docs/mapping.md lists all.

exit codes: 0 every wheel identified; 1 the data of a wheel do not support an answer, or an answer
is unreliable and --accept-unreliable was not given (the identifiable results are written; the
message says what to record next); 2 wrong usage or unreadable input (nothing is written).
"""


def parser() -> Parser:
    """Return the parser of the command line."""
    made = Parser(
        prog=NAME,
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = made.add_argument
    add("bags", nargs="+", metavar="BAG", help="recording, or folder of recordings")
    add("--output", "-o", metavar="DIR", help="folder for the results")
    add("--force", action="store_true", help="replace existing results")
    add("--validate", action="append", default=[], metavar="BAG",
        help="recording for validation only; may be repeated")  # fmt: skip
    add("--wheel", action="append", default=[], metavar="NAME",
        help="identify only this wheel; may be repeated")  # fmt: skip
    add("--model", default="auto",
        help="first_order, second_order, electromechanical, or auto (default): the simplest "
        "that explains the recording")  # fmt: skip
    add("--fix", action="append", default=[], metavar="NAME=VALUE",
        help="known parameter in SI, such as resistance=12.9; may be repeated")  # fmt: skip
    add("--accept-unreliable", action="store_true", help="exit with 0 for unreliable values")
    add("--map", action="extend", nargs="+", default=[], metavar="KEY=VALUE",
        help="which column or topic is which signal; see below")  # fmt: skip
    add("--mapping", metavar="FILE", help="the same in a YAML file")
    add("--msg", action="append", default=[], metavar="FILE",
        help=".msg file of an unknown message type")  # fmt: skip
    add(
        "--controller", nargs="+", metavar=("FORMAT", "GAIN=VALUE"),
        help="reconstruct the voltage from set-points (--map setpoint=...) of a known controller: "
        "linorobot2, ros_arduino_bridge, arduino_pid or ros2_controllers",
    )  # fmt: skip
    add("--topics", action="store_true", help="list the signals and propose a mapping")
    add("--fleet", action="store_true",
        help="identify each recording by itself and compare them in one table")  # fmt: skip
    add("--scheduler", metavar="ADDRESS", help="with --fleet: address of a Dask scheduler")
    add("--history", metavar="FILE", help="draw a history of the node identifier in the report")
    add("--tuning", action="store_true", help="add the tuning page to the report (takes longer)")
    add("--what-next", action="store_true", help="propose the next recording")
    add("--accuracy", type=number(0, 1), default=0.01, metavar="SHARE",
        help="relative accuracy that --what-next plans for; default 0.01")  # fmt: skip
    add("--verbose", "-v", action="store_true", help="print all findings")
    add("--quiet", "-q", action="store_true", help="print errors only")
    return made


main = partial(run, parser, "identification")


if __name__ == "__main__":
    raise SystemExit(main())
