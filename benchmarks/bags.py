# SPDX-License-Identifier: Apache-2.0
"""Bags to records, against iterating and deserializing with rosbags, in one run.

    python benchmarks/bags.py [--seconds 60] [--rate 1000] [--long 10]

Writes bags of four wheels (MCAP and SQLite) into a temporary folder and prints, as ratios:
the whole way from file to four validated records against iterating the raw messages with
rosbags (target: at most 1.5) and against AnyReader with deserialize (target: at least 4 times
faster), and the peak of memory against the arrays (target: at most 6); the same for a bag that is
``--long`` times as long.  Each reading is the best of several in a process of its own, since
peaks of memory never fall.  Times are CPU times (user and system) of that process: all three ways
are one thread, and what else the machine does shall not decide.
"""

from __future__ import annotations

import argparse
import resource
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from smp_motor_ident.bag import BagWriter, read_records
from smp_motor_ident.bag.types import definition

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
STATE, DESCRIPTION = "smp_interfaces/msg/MotorState", "smp_interfaces/msg/MotorDescription"
START = 1_700_000_000_000_000_000


def aligned(data: bytes) -> bytes:
    return data + bytes(-(len(data) - 4) % 8)


def string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def messages(seconds: float, rate: float):
    """Yield topic, type, data and stamp of everything in the bag."""
    for wheel in WHEELS:
        head = aligned(b"\0\1\0\0" + string(f"{wheel}_wheel_joint"))
        data = aligned(head + struct.pack("<ddB", 65.5, 500.0, 16)) + struct.pack("<dd", 12.0, 9.0)
        yield f"/{wheel}/motor_description", DESCRIPTION, data, START
    step = round(1e9 / rate)
    for k in range(int(seconds * rate)):
        stamp = START + k * step
        for w, wheel in enumerate(WHEELS):
            second, rest = divmod(stamp, 1_000_000_000)
            head = struct.pack("<4sii", b"\0\1\0\0", second, rest) + string(f"{wheel}_wheel_joint")
            volts = 12 * np.sin(0.001 * k * (w + 1))
            count = (k * (w + 3) + 32768) % 65536 - 32768
            numbers = (volts, 0.1 * volts, 0.5 * w, 0.01 * k, count, volts / 12)
            yield (
                f"/{wheel}/motor_state",
                STATE,
                aligned(head) + struct.pack("<ddddqd", *numbers),
                stamp + 150_000,
            )


def write_mcap(path: Path, seconds: float, rate: float) -> None:
    with BagWriter(path) as bag:
        for topic, kind, data, stamp in messages(seconds, rate):
            bag.write(topic, kind, data, stamp)


def write_sqlite(path: Path, seconds: float, rate: float) -> None:
    """Write a bare .db3 of schema 4, as rosbag2 of Jazzy does."""
    database = sqlite3.connect(path)
    database.executescript(
        "PRAGMA synchronous=OFF;"
        "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);"
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,"
        " type_description_hash TEXT NOT NULL);"
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,"
        " encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL,"
        " type_description_hash TEXT NOT NULL);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
        " timestamp INTEGER NOT NULL, data BLOB NOT NULL);"
        "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
        "INSERT INTO schema VALUES (4, 'jazzy');"
    )
    ids: dict[str, int] = {}
    hashes: dict[str, str] = {}

    def row(item):
        topic, kind, data, stamp = item
        if kind not in hashes:
            text, hashes[kind] = definition(kind)
            database.execute(
                "INSERT INTO message_definitions VALUES (NULL, ?, 'ros2msg', ?, ?)",
                (kind, text, hashes[kind]),
            )
        if topic not in ids:
            ids[topic] = len(ids) + 1
            database.execute(
                "INSERT INTO topics VALUES (?, ?, ?, 'cdr', '', ?)",
                (ids[topic], topic, kind, hashes[kind]),
            )
        return ids[topic], stamp, data

    for item in messages(seconds, rate):
        database.execute("INSERT INTO messages VALUES (NULL, ?, ?, ?)", row(item))
    database.commit()
    database.close()


def ours(path: Path) -> int:
    records = read_records(path)
    assert set(records) == set(WHEELS)
    return sum(
        column.nbytes
        for r in records.values()
        for column in (r.time, r.voltage, r.current, r.velocity, r.position, r.count)
    )


def raw(path: Path) -> int:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        return sum(1 for _ in reader.messages())


def deserialized(path: Path) -> int:
    from rosbags.highlevel import AnyReader

    count = 0
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            count += 1
    return count


WAYS: dict[str, Callable[[Path], int]] = {"ours": ours, "raw": raw, "deserialized": deserialized}


def peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def measure(way: str, path: Path, repeat: int) -> None:
    """Print CPU time [s], result and peak memory of a way."""
    import rosbags.highlevel  # noqa: F401  (loaded before the memory is looked at)

    small = path.parent / ("small" if path.is_dir() else "small.db3")
    WAYS[way](small)
    before, best, result = peak(), float("inf"), 0
    for _ in range(repeat):
        begin = time.process_time()
        result = WAYS[way](path)
        best = min(best, time.process_time() - begin)
    print(best, result, peak() - before)


def run(way: str, path: Path, repeat: int) -> tuple[float, int, int]:
    command = [sys.executable, __file__, "--measure", way, str(path), str(repeat)]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return float(out[0]), int(out[1]), int(out[2])


def report(name: str, path: Path, repeat: int, peers: bool) -> None:
    seconds, size, memory = run("ours", path, repeat)
    text = f"{name:16s} ours {seconds:7.3f} s   memory {memory / size:4.2f} x the arrays"
    if peers:
        iterated, count, _ = run("raw", path, repeat)
        decoded, _, _ = run("deserialized", path, 2)
        text += (
            f"   {count} messages   {seconds / iterated:4.2f} x raw iteration ({iterated:.3f} s)"
            f"   {decoded / seconds:5.1f} x faster than deserializing ({decoded:.3f} s)"
        )
    print(text, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--long", type=float, default=10.0, help="factor; 0 leaves it out")
    parser.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        way, path, repeat = arguments.measure
        measure(way, Path(path), int(repeat))
        return
    with tempfile.TemporaryDirectory() as folder:
        for factor, repeat in ((1.0, 5), (arguments.long, 1)):
            if not factor:
                continue
            base = Path(folder, f"x{factor:g}")
            base.mkdir()
            for kind, write, name in (("MCAP", write_mcap, ""), ("SQLite", write_sqlite, ".db3")):
                write(base / f"small{name}", 0.1, arguments.rate)
                bag = base / f"bag{name}"
                write(bag, arguments.seconds * factor, arguments.rate)
                report(f"{kind} x{factor:g}", bag, repeat, peers=factor == 1.0)


if __name__ == "__main__":
    main()
