# SPDX-License-Identifier: Apache-2.0
"""Compare ``identify --fleet`` on a Dask cluster with one process: numbers, time, a killed worker.

    pip install distributed
    python benchmarks/fleet.py                  # 200 recordings
    python benchmarks/fleet.py --bags 20

Recordings of simulated motors are identified one after the other in this process, then by a local
cluster of two workers, one of them killed half-way.  All numbers must be equal to the bit, no
result may be lost, and the cluster without a kill must be at least 1.6 times as fast.  The package
is the installed one with its compiled code on the disk: code compiled while running may sum in
another order than loaded code.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# A worker would take a look at its own stack every 10 ms, which is an eighth of this work.
os.environ.setdefault("DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED", "False")

from smp_motor_control.motor.file import load_motors  # noqa: E402
from smp_motor_control.motor.friction import Motor  # noqa: E402
from smp_motor_ident.bag import parse_mapping  # noqa: E402
from smp_motor_ident.cli import fleet  # noqa: E402

STEP = 0.01
FASTER = 1.6


def make(folder: Path, count: int, seconds: float) -> list[str]:
    """Write recordings of the paper's motors, ten robots with as many dates as it takes."""
    motors = list(load_motors(ROOT / "config" / "motors_paper.yaml").values())
    paths = []
    for k in range(count):
        rng = np.random.default_rng(k)
        motor = Motor(motors[k % len(motors)].parameters)
        rows = []
        volts = np.repeat(rng.uniform(-8, 8, round(seconds / STEP / 20)), 20)
        for n, u in enumerate(volts):
            rows.append((n * STEP, u, motor.speed + rng.normal(0.0, 0.3)))
            motor.step(float(u), STEP)
        path = folder / f"robot{k % 10}" / f"day{k // 10}.csv"
        path.parent.mkdir(exist_ok=True)
        np.savetxt(path, rows, delimiter=",", header="t,u,w", comments="", fmt="%.9g")
        paths.append(str(path))
    return paths


def by_two(paths: list[str], settings: tuple[Any, ...], kill: bool) -> tuple[Any, float]:
    """Identify on two workers; return the results and the time [s]."""
    from dask.distributed import LocalCluster  # type: ignore[import-not-found]

    with LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        warm(cluster, settings, paths[:1])
        found: dict[str, Any] = {}
        begin = time.monotonic()
        for path, result in fleet.identify_on_cluster(paths, settings, cluster.scheduler_address):
            found[path] = result
            if kill and len(found) == len(paths) // 2:
                victim = next(iter(cluster.workers.values())).pid
                threading.Thread(target=os.kill, args=(victim, signal.SIGKILL)).start()
        return found, time.monotonic() - begin


def warm(cluster: Any, settings: tuple[Any, ...], paths: list[str]) -> None:
    """Let every worker load its modules, as this process has."""
    from dask.distributed import Client

    with Client(cluster) as client:
        client.run(fleet.identify_one, paths[0], settings)


def main() -> int:
    """Run both ways; exit code 1 where something does not hold."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--bags", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each; default 10")
    given = parser.parse_args()
    settings = (parse_mapping(["time=t", "voltage=u", "velocity=w"], []), "auto", {})
    with tempfile.TemporaryDirectory() as folder:
        paths = make(Path(folder), given.bags, given.seconds)
        fleet.identify_one(paths[0], settings)
        begin = time.monotonic()
        alone = {path: fleet.identify_one(path, settings) for path in paths}
        took = time.monotonic() - begin
        print(f"one process: {given.bags} recordings in {took:.1f} s", flush=True)
        whole, quick = by_two(paths, settings, kill=False)
        print(f"two workers: {quick:.1f} s, {took / quick:.2f} times as fast", flush=True)
        cut, slow = by_two(paths, settings, kill=True)
        lost = sum(any(row.failure for row in rows) for rows in cut.values())
        print(f"one of two killed half-way: {slow:.1f} s, {lost} lost")
    same = whole == alone and cut == alone
    for path, one in alone.items():
        for other in (whole[path], cut[path]):
            if other != one:
                print(f"{path}:\n  {one}\n  {other}")
    known = sum(not any(row.failure for row in rows) for rows in alone.values())
    load = os.getloadavg()[0]
    print(f"numbers {'are' if same else 'are NOT'} the same; {known} of {given.bags} identified; "
          f"load {load:.1f}")  # fmt: skip
    return 0 if same and not lost and took / quick >= FASTER else 1


if __name__ == "__main__":
    sys.exit(main())
