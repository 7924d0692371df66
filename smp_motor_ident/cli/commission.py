# SPDX-License-Identifier: Apache-2.0
"""``commission``: identify and tune the user's running robot, wheels off the ground."""

from functools import partial

from smp_motor_ident.cli.frame import OF_ROS, Parser, number, run

NAME = "commission"

DESCRIPTION = """\
Check the wheels of the running robot, excite and record them, identify the motors, validate the
models on another run, design gains, and test them in a drive. With --apply gains that pass stay.
Put the robot on blocks first: the wheels turn. Active controllers are switched off meanwhile and
on again at the end.
"""


def parser() -> Parser:
    """Return the parser of the command line."""
    made = Parser(prog=NAME, description=DESCRIPTION, epilog=OF_ROS)
    add = made.add_argument
    add("--output", "-o", metavar="DIR", required=True, help="new folder for bag and results")
    add("--wheel", action="append", metavar="NAME", help="only this; default: all that report")
    add("--amplitude", type=number(0), help="largest voltage [V]; default 6")
    add("--duration", type=number(0), help="of each of three signals [s]; default 15")
    add("--motors", metavar="FILE", help="motor file with known values, to check the gearing by")
    add("--max-speed", type=number(0), metavar="RAD/S",
        help="of a wheel; default: half more than its checks show for the voltage")  # fmt: skip
    add("--max-current", type=number(0), default=0.0, metavar="A", help="of a motor; default any")
    add("--accept", action="append", default=[], metavar="CODE", help="do not stop at this finding")
    add("--apply", action="store_true", help="leave gains that pass in the running controllers")
    add("--resume", action="store_true", help="go on in DIR where an earlier run was cut off")
    add("--dry-run", action="store_true", help="print and draw what would be done, and end")
    add("--tuning", action="store_true", help="add the tuning page to the report (takes longer)")
    add("--yes", "-y", action="store_true", help="do not ask before the wheels move")
    return made


main = partial(run, parser, "commissioning")


if __name__ == "__main__":
    raise SystemExit(main())
