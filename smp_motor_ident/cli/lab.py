# SPDX-License-Identifier: Apache-2.0
"""``lab``: a page to watch, excite, identify, tune and drive a robot by hand and eye."""

from functools import partial

from smp_motor_ident.cli.frame import ROS_HELP, Parser, number, run

NAME = "lab"

DESCRIPTION = """\
Put the robot on blocks first: the wheels turn. Serve a page that watches the wheels of the running
robot, excites and identifies its motors, tunes its controllers on trial and drives it. Nothing
moves before it is armed on the page; one page drives, others watch.
"""


def parser() -> Parser:
    """Return the parser of the command line."""
    made = Parser(prog=NAME, description=DESCRIPTION, epilog=ROS_HELP)
    add = made.add_argument
    add("--demo", action="store_true", help="start a simulated robot to work with")
    add("--output", "-o", default="lab_output", metavar="DIR",
        help="new folder for recordings and results; default lab_output")  # fmt: skip
    add("--wheel", action="append", metavar="NAME",
        help="only this wheel; may be repeated; default: all that report")  # fmt: skip
    add("--max-speed", type=number(0), default=0.0, metavar="RAD/S",
        help="speed at which an excitation stops; default: none")  # fmt: skip
    add("--max-current", type=number(0), default=0.0, metavar="A",
        help="current at which an excitation stops; default: none")  # fmt: skip
    add("--domain", type=int, help="with --demo: ROS domain; default: a free one")
    add("--host", default="127.0.0.1", help="address to serve; default 127.0.0.1, this machine")
    add("--port", type=int, default=0, help="port to serve; default: a free one")
    add("--no-browser", action="store_true", help="open no browser, print the address only")
    return made


main = partial(run, parser, "laboratory")
