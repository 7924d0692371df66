# SPDX-License-Identifier: Apache-2.0
"""``commission``: identify and tune the user's running robot, wheels off the ground."""

from functools import partial

from smp_motor_ident.cli.frame import ROS_HELP, Parser, number, run

NAME = "commission"

DESCRIPTION = """\
Put the robot on blocks first: the wheels turn. Check the wheels of the running robot, excite and
record them, identify the motors, validate the models on another recording, design gains, and test
them in a drive. --apply keeps gains that pass. Active controllers are deactivated meanwhile and
activated again at the end.
"""


def parser() -> Parser:
    """Return the parser of the command line."""
    made = Parser(prog=NAME, description=DESCRIPTION, epilog=ROS_HELP)
    add = made.add_argument
    add(
        "--output", "-o", metavar="DIR", required=True, help="new folder for recordings and results"
    )
    add("--wheel", action="append", metavar="NAME",
        help="only this wheel; may be repeated; default: all that report")  # fmt: skip
    add("--amplitude", type=number(0), metavar="V", help="largest voltage; default 6")
    add("--duration", type=number(0), metavar="S",
        help="length of each of the three signals; default 15")  # fmt: skip
    add("--motors", metavar="FILE", help="motor file with the known gear ratio and gain")
    add("--max-speed", type=number(0), metavar="RAD/S",
        help="speed at which all wheels stop; default: 1.5 times that of the checks")  # fmt: skip
    add("--max-current", type=number(0), default=0.0, metavar="A",
        help="current at which all wheels stop; default: none")  # fmt: skip
    add("--accept", action="append", default=[], metavar="CODE",
        help="do not stop at this finding; may be repeated")  # fmt: skip
    add("--apply", action="store_true", help="keep gains that pass in the running controllers")
    add("--resume", action="store_true", help="continue an interrupted run in DIR")
    add("--dry-run", action="store_true", help="print the plan; nothing moves")
    add("--yes", "-y", action="store_true", help="do not ask before the wheels move")
    return made


main = partial(run, parser, "commissioning")
