# SPDX-License-Identifier: Apache-2.0
"""Read damaged files of every format, and print the outcomes in a table.

    python benchmarks/fuzz.py [--files 20000] [--seed 1] [--formats mcap csv ...]

Each file is a sound one (written by rosbags, mcap, sqlite3, scipy, h5py, openpyxl or by hand) with
some of its bytes changed, cut off, doubled, moved or replaced by extreme numbers.  The kinds in
PACKED spoil the content and then write a sound file around it: the XML of a workbook, the stamps
of a bag, the paths of an HDF5 file or of a folder with its links and pipes.

Outcomes: an answer; a partial answer with a warning; a refusal of one line.  Anything else
fails: a traceback, more than 30 s, more than 1 GB of memory.  Every failure is printed with its
number.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sqlite3
import struct
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import h5py
import lz4.frame
import mcap.writer
import numpy as np
import openpyxl
import scipy.io
import yaml
from backports import zstd
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from smp_motor_control.parameter_file import format_parameters
from smp_motor_ident.bag import list_topics, load_mapping, read_records
from smp_motor_ident.cli.tune import main as main_of_tune
from smp_motor_ident.errors import BagError, SignalError

N = 120
SECONDS, MEMORY = 30, 1_000_000_000
MESSAGES = ["voltage=/pwm.data velocity=/joint_states.velocity[right]"]
COLUMNS = ["voltage=u velocity=y time=t"]
COUNTS = ["voltage=u count=y time=t counts_per_revolution=2000"]
TUNE = ["--supply", "12", "--rate", "100", "--export"]
_RNG = np.random.default_rng(5)
T, U, Y = 0.01 * np.arange(N), _RNG.uniform(-6, 6, N), np.cumsum(_RNG.normal(0, 1, N))


def _messages(ros1: bool) -> tuple[Any, list[tuple[str, str, int, bytes]]]:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    number, joints = "std_msgs/msg/Float64", "sensor_msgs/msg/JointState"
    stamp, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    write = store.serialize_ros1 if ros1 else store.serialize_cdr
    sent = []
    for k in range(N):
        at = 1_700_000_000_000_000_000 + round(1e9 * T[k])
        sent.append(("/pwm", number, at, bytes(write(store.types[number](float(U[k])), number))))
        head = [k] if ros1 else []
        message = store.types[joints](
            header(*head, stamp(*divmod(at, 10**9)), "base"),
            ["left", "right"], np.zeros(2), np.array([0.0, Y[k]]), np.zeros(0),
        )  # fmt: skip
        sent.append(("/joint_states", joints, at, bytes(write(message, joints))))
    return store, sent


def _mcap(kind: str, stamps: bytes | None = None) -> bytes:
    store, sent = _messages(False)
    if stamps is not None:
        times = struct.iter_unpack("<Q", stamps[: len(stamps) // 8 * 8])
        sent = [(*one[:2], at, one[3]) for one, (at,) in zip(sent, times)]
    file, ids = io.BytesIO(), {}
    writer = mcap.writer.Writer(
        file, chunk_size=2048, compression=mcap.writer.CompressionType[kind]
    )
    writer.start("ros2")
    for topic, name, at, data in sent:
        if topic not in ids:
            text = store.generate_msgdef(name, ros_version=2)[0].encode()
            schema = writer.register_schema(name, "ros2msg", text)
            ids[topic] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(ids[topic], at, data, at)
    writer.finish()
    return file.getvalue()


def _sqlite() -> bytes:
    _, sent = _messages(False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.db3")
        base = sqlite3.connect(path)
        base.executescript(
            "PRAGMA page_size=1024;"
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
            " serialization_format TEXT, offered_qos_profiles TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
            " data BLOB);"
        )
        ids: dict[str, int] = {}
        for topic, name, at, data in sent:
            if topic not in ids:
                ids[topic] = len(ids) + 1
                base.execute(
                    "INSERT INTO topics VALUES (?,?,?,'cdr','')", (ids[topic], topic, name)
                )
            base.execute("INSERT INTO messages VALUES (NULL,?,?,?)", (ids[topic], at, data))
        base.commit()
        base.close()
        return path.read_bytes()


def _ros1(kind: Ros1Writer.CompressionFormat | None) -> bytes:
    store, sent = _messages(True)
    with tempfile.TemporaryDirectory() as folder:
        path, ids = Path(folder, "a.bag"), {}
        writer = Ros1Writer(path)
        writer.chunk_threshold = 2048
        if kind:
            writer.set_compression(kind)
        with writer:
            for topic, name, at, data in sent:
                if topic not in ids:
                    ids[topic] = writer.add_connection(topic, name, typestore=store)
                writer.write(ids[topic], at, data)
        return path.read_bytes()


def _mat(packed: bool) -> bytes:
    file = io.BytesIO()
    content = {"t": T, "u": U, "y": Y, "s": {"a": T, "b": ["x", "y"]}, "c": "text"}
    scipy.io.savemat(file, content, do_compression=packed)
    return file.getvalue()


def _wpilog() -> bytes:
    def record(entry: int, stamp: int, payload: bytes) -> bytes:
        return struct.pack("<BBBI", 0x30, entry, len(payload), stamp) + payload

    parts = [b"WPILOG", struct.pack("<HI", 0x0100, 0)]
    for entry, name in enumerate((b"u", b"y"), 1):
        text = struct.pack("<BIIcI6sI", 0, entry, 1, name, 6, b"double", 0)
        parts.append(record(0, 0, text))
    for k in range(N):
        for entry, value in enumerate((U[k], Y[k]), 1):
            parts.append(record(entry, round(1e6 * T[k]), struct.pack("<d", value)))
    return b"".join(parts)


def _xlsx() -> bytes:
    book, file = openpyxl.Workbook(), io.BytesIO()
    for row in [("t", "u", "y"), *zip(T, U, Y)]:
        book.active.append(row)
    book.save(file)
    return file.getvalue()


def _rows() -> list[dict[str, float]]:
    return [{"t": t, "u": u, "y": y} for t, u, y in zip(T.tolist(), U.tolist(), Y.tolist())]


def _csv(separator: str) -> bytes:
    lines = [separator.join("tuy"), *(separator.join(map(repr, r.values())) for r in _rows())]
    return "\n".join(lines).encode()


def _wide() -> bytes:
    head, *rows = _csv(",").split(b"\n")
    names = b"".join(b",c%d" % k for k in range(2000))
    return b"\n".join([head + names, *(row + b",0" * 2000 for row in rows)])


def _sysid() -> bytes:
    rows = np.stack([T, U, Y, Y], axis=1).tolist()
    return json.dumps({"sysid": True, "units": "Rotations", "slow-forward": rows}).encode()


def _frc() -> bytes:
    rows = np.stack([T, 12 + 0 * T, U / 12, U, Y, Y], axis=1).tolist()
    return json.dumps(
        {"units": "Degrees", "unitsPerRotation": 360.0, "slow-forward": rows}
    ).encode()


def _counts(bits: int) -> bytes:
    counts = np.cumsum(np.rint(40 * Y)).astype(np.int64) % 2**bits
    return "\n".join(["t,u,y", *map("{:.2f},{:.3f},{}".format, T, U, counts)]).encode()


def _angle() -> bytes:
    angle = np.mod(np.cumsum(Y) / 10, 2 * np.pi)
    return "\n".join(["t,u,y", *map("{:.2f},{:.3f},{:.5f}".format, T, U, angle)]).encode()


def _dated() -> bytes:
    stamps = [f"2024-05-01 23:59:{t + 58.5:09.6f}" for t in T]
    return "\n".join(["t;u;y", *map("{};{:.1f}%;{:.4f};".format, stamps, U, Y)]).encode()


def _hdf5() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.mat")
        with h5py.File(path, "w", userblock_size=512) as file:
            file["t"], file["u"], file["g/y"] = T, U, Y
        return b"MATLAB 7.3 MAT-file" + path.read_bytes()[19:]


def _identification() -> bytes:
    of = {"value": 25.0, "std": 0.1, "ci95": [24.8, 25.2], "unit": "", "status": "estimated"}
    gains = {"dc_gain": of, "time_constant": {**of, "value": 0.05}}
    error = {"frequency": [1.0, 2.0, 4.0], "shown": [0.1, 0.1, 0.1], "bound": [0.2, 0.2, 0.2]}
    covariance = {"names": list(gains), "matrix": [[0.01, 0.0], [0.0, 1e-8]]}
    motor = {
        "model": "first_order", "parameters": {}, "combinations": gains, "covariance": covariance,
        "residuals": {"white": True, "independent_of_input": True, "model_error": error},
        "alternatives": [{"dc_gain": 25.0, "delay": 0.0}], "hardware": {"supply_voltage": 12.0},
        "findings": [], "sources": ["bag"], "sample_time": 0.01, "speed_noise": 0.5,
    }  # fmt: skip
    return json.dumps({"schema": 1, "motors": {"front_left": motor}}).encode()


def _motors() -> bytes:
    motor = {"dc_gain": 25.0, "time_constant": 0.05, "gear_ratio": 65.5, "supply_voltage": 12.0}
    return format_parameters({"/**/motor_plant": {"motors": {"left": motor}}}).encode()


def _metadata() -> bytes:
    entry = {"name": "/pwm", "type": "std_msgs/msg/Float64", "serialization_format": "cdr"}
    return yaml.safe_dump(
        {
            "rosbag2_bagfile_information": {
                "version": 9,
                "relative_file_paths": ["a.mcap"],
                "topics_with_message_count": [{"topic_metadata": entry, "message_count": N}],
            }
        }
    ).encode()


def _stamps() -> bytes:
    return b"".join(struct.pack("<Q", at) for _, _, at, _ in _messages(False)[1])


def _sheet() -> bytes:
    with zipfile.ZipFile(io.BytesIO(_xlsx())) as book:
        return book.read(SHEET)


def _pack_sheet(data: bytes, path: Path) -> Path:
    with zipfile.ZipFile(io.BytesIO(_xlsx())) as book, zipfile.ZipFile(path, "w") as new:
        for item in book.infolist():
            new.writestr(item, data if item.filename == SHEET else book.read(item))
    return path


def _pack_stamps(data: bytes, path: Path) -> Path:
    path.write_bytes(_mcap("NONE", data))
    return path


def _pack_groups(data: bytes, path: Path) -> Path:
    """Write an HDF5 file of the variables "PATH=COLUMN" and the links "PATH>PATH"."""
    columns = {"t": T, "u": U, "y": Y}
    with h5py.File(path, "w", userblock_size=512) as file:
        for line in data.decode("latin-1").replace("\0", "").splitlines():
            name, variable, column = line.partition("=")
            link, _, goal = line.partition(">")
            with contextlib.suppress(OSError, ValueError, RuntimeError, KeyError):
                if variable:
                    file[name] = columns.get(column, np.zeros(3))
                else:
                    file[link] = h5py.SoftLink(goal) if len(goal) % 2 else file[goal]
    path.write_bytes(b"MATLAB 7.3 MAT-file" + path.read_bytes()[19:])
    return path


def _pack_folder(data: bytes, path: Path) -> Path:
    """Write a folder of the files "PATH=", the pipes "PATH|" and the links "PATH>PATH"."""
    path.mkdir()
    for line in data.replace(b"\0", b"").splitlines():
        name = line.rstrip(b"=|").partition(b">")[0].replace(b"..", b"").lstrip(b"/")
        new, goal = os.path.join(os.fsencode(path), name), line.partition(b">")[2]
        with contextlib.suppress(OSError, ValueError):
            os.makedirs(os.path.dirname(new), exist_ok=True)
            if line.endswith(b"|"):
                os.mkfifo(new)
            elif goal:
                inside = goal.replace(b"..", b"").lstrip(b"/")
                os.symlink(goal if goal == b"/dev/zero" else inside or b".", new)
            else:
                Path(os.fsdecode(new)).write_bytes(_csv(","))
    return path


SHEET = "xl/worksheets/sheet1.xml"
PLACES = b"a/log.csv=\na/b/log.csv=\nlog.csv=\na/self>.\nlink>a\npipe.csv|\nzero>/dev/zero\n"
GROUPS = b"t=t\nu=u\ng/y=y\ng/h/i/j=y\nlink>/g\nself>/link\n"
PACKED: dict[str, Callable[[bytes, Path], Path]] = {
    "xlsx sheet": _pack_sheet,
    "mcap stamps": _pack_stamps,
    "mat 7.3 groups": _pack_groups,
    "folder": _pack_folder,
}
"""The functions that write a spoilt content as a sound file."""

SEEDS: dict[str, tuple[str, Callable[[], bytes], list[str] | None]] = {
    "mcap": ("a.mcap", lambda: _mcap("NONE"), MESSAGES),
    "mcap zstd": ("a.mcap", lambda: _mcap("ZSTD"), MESSAGES),
    "mcap lz4": ("a.mcap", lambda: _mcap("LZ4"), MESSAGES),
    "mcap.zstd": ("a.mcap.zstd", lambda: zstd.compress(_mcap("NONE")), MESSAGES),
    "mcap.lz4": ("a.mcap.lz4", lambda: lz4.frame.compress(_mcap("NONE")), MESSAGES),
    "sqlite": ("a.db3", _sqlite, MESSAGES),
    "ros1": ("a.bag", lambda: _ros1(None), MESSAGES),
    "ros1 bz2": ("a.bag", lambda: _ros1(Ros1Writer.CompressionFormat.BZ2), MESSAGES),
    "ros1 lz4": ("a.bag", lambda: _ros1(Ros1Writer.CompressionFormat.LZ4), MESSAGES),
    "mat": ("a.mat", lambda: _mat(False), COLUMNS),
    "mat packed": ("a.mat", lambda: _mat(True), COLUMNS),
    "wpilog": ("a.wpilog", _wpilog, ["voltage=u velocity=y"]),
    "sysid": ("a.json", _sysid, None),
    "json": ("a.json", lambda: json.dumps(_rows()).encode(), COLUMNS),
    "jsonl": ("a.jsonl", lambda: "\n".join(map(json.dumps, _rows())).encode(), COLUMNS),
    "xlsx": ("a.xlsx", _xlsx, COLUMNS),
    "csv": ("a.csv", lambda: _csv(","), COLUMNS),
    "csv counts": ("a.csv", lambda: _counts(16), COUNTS),
    "csv near 2^62": ("a.csv", lambda: _counts(62), COUNTS),
    "csv angle": ("a.csv", _angle, ["voltage=u position=y time=t"]),
    "csv dates": ("a.csv", _dated, [*COLUMNS, "supply_voltage=12"]),
    "frc": ("a.json", _frc, None),
    "mat 7.3": ("a.mat", _hdf5, ["voltage=u velocity=g.y time=t"]),
    "identification": ("identification.json", _identification, None),
    "motors": ("motors.yaml", _motors, None),
    "csv blanks": ("a.txt", lambda: _csv(" "), COLUMNS),
    "metadata": ("metadata.yaml", _metadata, MESSAGES),
    "mapping": ("map.yaml", lambda: b"motors:\n  left: {voltage: /pwm.data, velocity: y}\n", None),
    "csv wide": ("a.csv", _wide, COLUMNS),
    "xlsx sheet": ("a.xlsx", _sheet, COLUMNS),
    "mcap stamps": ("a.mcap", _stamps, MESSAGES),
    "mat 7.3 groups": ("a.mat", lambda: GROUPS, ["voltage=u velocity=g.y time=t"]),
    "folder": ("folder", lambda: PLACES, COLUMNS),
    "msg": ("Float64.msg", lambda: b"float64 data\nFloat64[<=3] more\nuint8 X=1\n", MESSAGES),
}
"""File name, its sound bytes, and the mapping, by format."""

EXTREME = [
    *(struct.pack("<I", v) for v in (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)),
    *(struct.pack("<Q", v) for v in (0, 2**31, 2**63 - 1, 2**63, 2**64 - 1)),
    *(struct.pack("<d", v) for v in (np.nan, np.inf, 1e300, -1e-300)),
    b"\0", b"\xff" * 16, b"\n", b",", b"[" * 4000, b"{" * 3000, b'{"a":' * 2000, b"9" * 5000,
    b"1152921504606846976", b"-9223372036854775808", b"2262-05-01 00:00:00", b"1e18", b"\r;",
    b'"', b"%", b"1e999", b"&a [*a]", b"- " * 2000, b'1048577"', b"XFE", b"1," * 5000, b"g/" * 900,
    b"\nb>a\nb>/\n", b"\nself>.\n", b"\xff.csv=\n", b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18",
]  # fmt: skip


def spoil(data: bytes, draw: random.Random) -> bytes:
    """Return a recording with one to eight places spoilt."""
    spoilt = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 3, 8))):
        size = len(spoilt)
        at = draw.choice((draw.randrange(size + 1), draw.randrange(min(size, 200) + 1)))
        match draw.randrange(8):
            case 0:
                del spoilt[at:]
            case 1 | 2 if at < size:
                spoilt[at] ^= 1 << draw.randrange(8)
            case 3 if at < size:
                spoilt[at] = draw.randrange(256)
            case 4 | 5:
                piece = draw.choice(EXTREME)
                spoilt[at : at + (len(piece) if len(piece) < 20 else 0)] = piece
            case 6:
                begin = draw.randrange(size + 1)
                spoilt[at:at] = spoilt[begin : begin + draw.randrange(1, 400)]
            case _:
                del spoilt[at : at + draw.randrange(1, 200)]
    return bytes(spoilt)


def outcome(name: str, data: bytes, folder: Path) -> str:
    """Return what comes of a file: an answer, a partial answer, a refusal of one line."""
    file, _, mapping = SEEDS[name]
    path = folder / file
    target = PACKED[name](data, path) if name in PACKED else path
    if name not in PACKED:
        path.write_bytes(data)
    if name == "metadata":
        (folder / "a.mcap").write_bytes(SOUND["mcap"])
        target = folder
    try:
        if name == "mapping":
            load_mapping(path)
            return "answer"
        if name in ("identification", "motors"):
            return tuned(path)
        if name == "msg":
            (folder / "a.db3").write_bytes(SOUND["sqlite"])
            list_topics(folder / "a.db3", [str(path)])
            return "answer"
        listed = list_topics(target)
        records = read_records(target, mapping)
    except (BagError, SignalError) as error:
        text = str(error)
        return "refused" if text and "\n" not in text and len(text) < 4000 else "long message"
    finally:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        (folder / "a.mcap").unlink(missing_ok=True)
        (folder / "a.db3").unlink(missing_ok=True)
    found = [f for r in records.values() for f in r.findings] + [
        f for o in listed for f in o.findings
    ]
    return "partial" if any(f.severity != "note" for f in found) else "answer"


def tuned(path: Path) -> str:
    """Return what ``tune`` makes of a file, which must be a text or one line."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main_of_tune([str(path), *TUNE, "arduino_pid"])
    said = [s for s in err.getvalue().splitlines() if not s.startswith("tune: designing")]
    if code == 0:
        return "answer" if not said else "partial"
    if len(said) != 1 or "a defect of this tool" in said[0]:
        return said[-1][:200] if said else f"code {code} without a word"
    return "refused"


SOUND: dict[str, bytes] = {}


class Hung(BaseException):
    """A file took too long: no error that a reader may take for one of its own."""


def campaign(name: str, count: int, seed: int) -> tuple[str, Counter[str], list[str], float, float]:
    """Fuzz one format; return the counts, what failed, the memory and the longest time."""
    SOUND.update({key: SEEDS[key][1]() for key in {name, "mcap", "sqlite"}})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    counts: Counter[str] = Counter()
    failures: list[str] = []
    longest = 0.0

    def stop(*_: object) -> None:
        raise Hung

    signal.signal(signal.SIGALRM, stop)
    with tempfile.TemporaryDirectory() as place:
        for k in range(count):
            data = spoil(SOUND[name], random.Random(f"{name} {seed} {k}"))
            start = time.perf_counter()
            signal.alarm(SECONDS)
            try:
                result = outcome(name, data, Path(place))
            except BaseException as error:
                result = type(error).__name__
            signal.alarm(0)
            longest = max(longest, time.perf_counter() - start)
            counts[result] += 1
            if result not in ("answer", "partial", "refused"):
                failures.append(f"{name}, seed {seed}, file {k}: {result}")
    used = 1024.0 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    if used > MEMORY:
        failures.append(f"{name}, seed {seed}: {used / 1e6:.0f} MB")
    return name, counts, failures, used, longest


def alone(name: str, count: int, seed: int) -> tuple[str, Counter[str], list[str], float, float]:
    """Fuzz one format in a process of its own, whose death is a failure."""
    try:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            return process.submit(campaign, name, count, seed).result()
    except BrokenProcessPool:
        return name, Counter(), [f"{name}, seed {seed}: the process died"], 0.0, 0.0


def main() -> int:
    """Run the campaign; exit code 1 where anything failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--files", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--formats", nargs="+", default=list(SEEDS), choices=list(SEEDS))
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    each = max(given.files // len(given.formats), 1)
    print(f"seed {given.seed}, {each} files of each format")
    print("format           answer  partial  refused  failed     MB      s")
    every: Counter[str] = Counter()
    bad: list[str] = []
    with ThreadPoolExecutor(given.jobs) as threads:
        work = threads.map(lambda name: alone(name, each, given.seed), given.formats)
        for name, counts, failures, used, longest in work:
            three = [counts[key] for key in ("answer", "partial", "refused")]
            print(
                f"{name:15} {three[0]:7} {three[1]:8} {three[2]:8} {each - sum(three):7} "
                f"{used / 1e6:6.0f} {longest:6.1f}",
                flush=True,
            )
            every += counts
            bad += failures
    print(f"all: {dict(every)}")
    print("\n".join(bad[:50]) or "no traceback, no hang, memory within bounds")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
