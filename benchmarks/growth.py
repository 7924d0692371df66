"""Time and memory of a cold fit against the number of samples, each in a process of its own."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from known_motors import TABLE_1, recording, table

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.structures import SecondOrder
from smp_motor_ident.record import Hardware, Record

CASES = (
    # what is called, what is measured, Coulomb friction [V]
    ("fit", "speed", 0.0),
    ("fit", "speed", 0.3),
    ("fit", "counts", 0.0),
    ("fit", "counts", 0.3),
    ("estimate()", "speed", 0.0),
    ("estimate()", "counts", 0.3),
)


def _peak() -> float:
    """Return the most memory that this process has had resident [MiB] since the mark."""
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0]) / 1024


def _resident() -> float:
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmRSS:")[1].split()[0]) / 1024


def _mark() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _load(folder: Path, counts: bool) -> Record:
    arrays = {p.stem: np.load(p) for p in folder.glob("*.npy")}
    hardware = Hardware(1.0, 500.0 if counts else None, 0, 12.0, None)
    return Record("motor", arrays["time"], arrays["voltage"], None, arrays.get("velocity"),
                  None, arrays.get("count"), hardware=hardware)  # fmt: skip


def child(folder: str, counts: bool, friction: bool, whole: bool) -> None:
    """Fit what lies in a folder and print time and memory as JSON."""
    record = _load(Path(folder), counts)
    structure = SecondOrder(friction="symmetric" if friction else "none")

    def call(given: Record) -> list[float]:
        if whole:
            e = estimate(given, "second_order")
            gain, tau = e.value("dc_gain"), e.value("time_constant")
            product = e.value("time_constant_product")
            return [float(x) for x in np.log([1 / gain, tau / gain, product / gain])]
        z = initial_fit(prepare([given], False), structure, Options()).z
        return [z.ln_a0, z.ln_a1, z.ln_a2]

    call(record.slice(0, min(len(record), 8_000)))  # compiled code into memory
    gc.collect()
    before = _resident()
    _mark()
    begun, spent = time.perf_counter(), time.process_time()
    found = call(record)
    wall, processor = time.perf_counter() - begun, time.process_time() - spent
    print(json.dumps({"wall": wall, "processor": processor, "more": _peak() - before, "z": found}))


def growth(most: int) -> None:
    """Print time and memory against the number of samples.

    Parameters
    ----------
    most : int
        Samples of the longest record.
    """
    sizes = [n for n in (10_000, 100_000, 1_000_000, 10_000_000) if n <= most]
    rows, exponents = [], []
    for what, kind, friction in CASES:
        times = []
        for n in sizes:
            row, processor = _one(what, kind, friction, n)
            rows.append(row)
            times.append(processor)
            print(row, flush=True)
        if len(sizes) > 2:
            slope = np.polyfit(np.log(sizes[1:]), np.log(times[1:]), 1)[0]
            exponents.append(f"{what}, {kind}, {friction} V: {slope:.2f}")
    head = ("call", "output", "friction", "samples", "wall s", "processor s", "per sample",
            "record", "more at its peak", "times the record", "error of ln a")  # fmt: skip
    print("\n" + table(head, rows))
    print(f"\nexponent of the growth from 100,000 samples on: {'; '.join(exponents)}")


def _one(what: str, kind: str, friction: float, n: int) -> tuple[tuple[object, ...], float]:
    counts = kind == "counts"
    made, z = recording(TABLE_1["rear_right"], current=False, seconds=n / 1000, rate=1000.0,
                        substeps=4, counts=counts, static_voltage=friction)  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        arrays = {"time": made.time, "voltage": made.voltage}
        if counts:
            arrays["count"] = made.count
        else:
            noise = 2.0 * np.random.default_rng(0).standard_normal(n)
            arrays["velocity"] = made.velocity + noise
        for name, values in arrays.items():
            np.save(Path(folder) / f"{name}.npy", values)
        size = sum(a.nbytes for a in arrays.values()) / 2**20
        del made, arrays
        flags = (counts, friction > 0, what != "fit")
        command = [sys.executable, __file__, folder, *(str(int(flag)) for flag in flags)]
        used = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    row = (
        what,
        kind,
        f"{friction} V",
        n,
        f"{used['wall']:.3f}",
        f"{used['processor']:.3f}",
        f"{1e9 * used['processor'] / n:.0f} ns",
        f"{size:.1f} MiB",
        f"{used['more']:.1f} MiB",
        f"{used['more'] / size:.1f}",
        f"{np.abs(np.array(used['z']) - z.array[:3]).max():.1e}",
    )
    return row, used["processor"]


if __name__ == "__main__":
    child(sys.argv[1], *(flag == "1" for flag in sys.argv[2:]))
