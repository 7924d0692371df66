"""tune: identification.json (or motors.yaml) in, gains for the wheel nodes or other loops out."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from smp_motor_ident.cli import frame
from smp_motor_ident.cli.tune_arguments import parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool."""
    return frame.run(parser(), _work, argv)


def _work(arguments: argparse.Namespace) -> int:
    # What computes is loaded after the arguments are understood.
    from smp_motor_ident.cli.tuning import work

    return work(arguments)


if __name__ == "__main__":
    sys.exit(main())
