# SPDX-License-Identifier: Apache-2.0
"""Play a bag into ``identifier``; compare its last estimates with the offline intervals.

    python benchmarks/replay.py demo_output        # of make demo: excitation and identification

Plays the excitation in its own time and waits until every wheel's last window was estimated.
Prints which values lie outside of the 95 % intervals of ``identify``, systematic uncertainty
included, how many deviations off, and the share of a processor that ``identifier`` took.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from smp_motor_ident.report.document import read_identification


def seconds_of(process: int) -> float:
    """Return the processor time that a process has taken."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(folder: Path) -> int:
    """Play, wait, compare; exit code 1 where a value is outside of its interval."""
    os.environ.setdefault("ROS_DOMAIN_ID", "107")
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    import rclpy

    from smp_interfaces.msg import MotorParameters
    from smp_motor_control.nodes.runtime import LATCHED

    offline = read_identification(folder / "identification")
    rclpy.init()
    node, heard, count = rclpy.create_node("replay"), {}, dict.fromkeys(offline, 0)

    def hear(wheel: str, message: MotorParameters) -> None:
        heard[wheel] = message
        count[wheel] += 1

    for wheel in offline:
        node.create_subscription(
            MotorParameters, f"/{wheel}/motor_parameters", lambda m, w=wheel: hear(w, m), LATCHED
        )

    def until(condition: object, within: float) -> None:
        end = time.monotonic() + within
        while not condition() and time.monotonic() < end:  # type: ignore[operator]
            rclpy.spin_once(node, timeout_sec=0.2)

    identifier = subprocess.Popen(["identifier"])
    try:
        until(lambda: len(heard) == len(offline), 120.0)
        before, begun = seconds_of(identifier.pid), time.monotonic()
        for bag in sorted((folder / "excitation").iterdir()):
            play = subprocess.Popen(["play", str(bag)])
            until(lambda play=play: play.poll() is not None, 600.0)
        share = (seconds_of(identifier.pid) - before) / (time.monotonic() - begun)
        print(f"identifier took {100 * share:.1f} % of a processor (load {os.getloadavg()[0]:.1f})")
        # An estimate under way is of an earlier window: quiet for a minute is the end.
        quiet = [sum(count.values()), time.monotonic()]

        def ended() -> bool:
            if sum(count.values()) != quiet[0]:
                quiet[:] = sum(count.values()), time.monotonic()
            return time.monotonic() - quiet[1] > 60.0

        until(ended, 900.0)
    finally:
        identifier.send_signal(signal.SIGINT)
        identifier.wait(60.0)
        rclpy.shutdown()
    outside = 0
    for wheel, found in offline.items():
        held, message = {**found.combinations, **found.parameters}, heard[wheel]
        off = [
            f"{name} by {(value - held[name].value) / held[name].std:+.2g} deviations"
            for name, value in zip(message.names, message.values)
            if (ends := held[name].total_ci95) and not ends[0] <= value <= ends[1]
        ]
        outside += bool(off) or not message.names
        print(f"{wheel}: {message.status}: {', '.join(off) or 'all within the intervals'}")
    return 1 if outside else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo_output")))
