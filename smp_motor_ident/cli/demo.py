# SPDX-License-Identifier: Apache-2.0
"""``demo``: a simulated robot from four unknown motors to four tuned wheels, checked at the end."""

from functools import partial

from smp_motor_ident.cli.frame import Parser, number, run

NAME = "demo"


def parser() -> Parser:
    """Return the parser of the command line."""
    made = Parser(prog=NAME, description=(
        "Start a simulated robot as real processes, excite and record its wheels, identify and "
        "tune them, drive it, and compare the results with the true motors. It ends by itself."
    ))  # fmt: skip
    made.add_argument("--output", "-o", default="demo_output", metavar="DIR",
        help="folder for the results; default demo_output")  # fmt: skip
    made.add_argument("--motors", metavar="FILE", help="the true motors; default: the paper's")
    made.add_argument("--rate", type=number(0), default=200.0, metavar="HZ",
        help="samples per second; default 200")  # fmt: skip
    made.add_argument("--domain", type=int, help="ROS domain; default: a free one")
    return made


main = partial(run, parser, "demonstration")
