# SPDX-License-Identifier: Apache-2.0
"""Times of the tools from the shell, now and before the redesign, alternating in one run.

    python benchmarks/shell.py demo_output/excitation     # of make demo
    python benchmarks/shell.py BAG --against COMMIT --runs 7

Medians of wall and processor time (children included) of ``identify --help`` and of ``identify``
with its report, of this version and of a commit, which is checked out and compiled first.
"""

from __future__ import annotations

import argparse
import compileall
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BEFORE = "89c5c98"  # the last commit before the redesign
CALL = "import sys; from smp_motor_control.entry import identify; sys.exit(identify())"


def run(tree: Path, *arguments: str) -> tuple[float, float]:
    """Return wall and processor time of one call of a version's ``identify`` [s]."""
    path = os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])
    begun, before = time.perf_counter(), os.times()
    subprocess.run([sys.executable, "-c", CALL, *arguments], cwd=tree, check=True,
                   env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.DEVNULL)  # fmt: skip
    after = os.times()
    took = after.children_user + after.children_system
    return time.perf_counter() - begun, took - before.children_user - before.children_system


def main() -> int:
    """Call both versions in turn and print the medians."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("bag", type=Path)
    parser.add_argument("--against", default=BEFORE, metavar="COMMIT")
    parser.add_argument("--runs", type=int, default=5)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        old, out = Path(folder) / "old", Path(folder) / "out"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(old), asked.against], check=True)
        try:
            calls = {
                "identify --help": ["--help"],
                "identify BAG": [str(asked.bag.resolve()), "--force", "--quiet", "-o", str(out)],
            }
            for tree in (ROOT, old):
                for package in ("smp_motor_control", "smp_motor_ident"):
                    compileall.compile_dir(tree / package, quiet=2)
                run(tree, *calls["identify BAG"])  # compiles functions on their first call
            print(f"{'':18}{'now':>16}{asked.against:>18}{'ratio':>16}")
            for name, arguments in calls.items():
                took = [(run(ROOT, *arguments), run(old, *arguments)) for _ in range(asked.runs)]
                for k, kind in enumerate(("wall", "processor")):
                    now, then = (statistics.median(t[v][k] for t in took) for v in (0, 1))
                    line = f"{name:18}{now:14.2f} s{then:16.2f} s{now / then:16.2f}"
                    print(f"{line}  {kind}", flush=True)
        finally:
            subprocess.run([*git, "remove", "--force", str(old)], check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
