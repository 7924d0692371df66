# SPDX-License-Identifier: Apache-2.0
"""``identify``: identify motors from recordings, each value with its uncertainty."""

import argparse
from functools import partial

from smp_motor_ident.cli.frame import Parser, number, run

NAME = "identify"

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

exit codes: 0 every wheel identified; 1 the data of some or all wheels do not support an answer,
or an answer is unreliable and --accept-unreliable was not given (what could be identified is
written; the message says what to record next); 2 wrong usage or unreadable input (nothing is
written).
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
    add("bags", nargs="+", metavar="BAG", help="bag, folder of bags, or CSV file")
    add("--output", "-o", metavar="DIR", help="folder for the results")
    add("--force", action="store_true", help="replace existing results")
    add("--validate", action="append", default=[], metavar="BAG", help="validate on this")
    add("--wheel", action="append", default=[], metavar="NAME", help="only this wheel")
    add("--model", default="auto", help="force a model instead of choosing one")
    add("--fix", action="append", default=[], metavar="NAME=VALUE", help="known parameter, in SI")
    add("--accept-unreliable", action="store_true", help="exit with 0 if values are unreliable")
    add("--map", action="extend", nargs="+", default=[], metavar="KEY=VALUE", help="see below")
    add("--mapping", metavar="FILE", help="mapping in a YAML file")
    add("--msg", action="append", default=[], metavar="FILE", help=".msg file of an unknown type")
    add(
        "--controller", nargs="+", metavar=("FORMAT", "GAIN=VALUE"),
        help="loop of a recording with set-points (--map setpoint=...) instead of voltages",
    )  # fmt: skip
    add("--topics", action="store_true", help="list the bag's topics and suggest a mapping")
    add("--fleet", action="store_true", help="identify each recording, compare in one table")
    add("--scheduler", metavar="ADDRESS", help="with --fleet: Dask cluster to use")
    add("--history", metavar="FILE", help="draw the history that identifier wrote")
    add("--tuning", action="store_true", help="add the tuning page to the report (takes longer)")
    add("--what-next", action="store_true", help="propose the next recording")
    add("--accuracy", type=number(0, 1), default=0.01, help="target of --what-next; default 0.01")
    add("--verbose", "-v", action="store_true", help="print all findings and notes")
    add("--quiet", "-q", action="store_true", help="print errors only")
    return made


main = partial(run, parser, "identification")


if __name__ == "__main__":
    raise SystemExit(main())
