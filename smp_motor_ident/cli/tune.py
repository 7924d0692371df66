"""tune: identification.json (or motors.yaml) in, gains for the wheel nodes or other loops out."""

from __future__ import annotations

from collections.abc import Sequence

from smp_motor_ident.cli.frame import run
from smp_motor_ident.cli.tune_arguments import parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code."""
    return run(parser(), "tuning", argv)


if __name__ == "__main__":
    raise SystemExit(main())
