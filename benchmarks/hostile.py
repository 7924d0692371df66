# SPDX-License-Identifier: Apache-2.0
"""Read files of at most 10 MB that claim far more content, several for every reader.

    python benchmarks/hostile.py [NAME ...]

A process of its own lists and reads each.  Either must end within 30 s of processor time, both
within 1 GB, with an answer or one line.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import sqlite3
import struct
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any

import h5py
import mcap.writer
import numpy as np
import openpyxl
import scipy.io

SECONDS, MEMORY, SIZE = 30, 1_000_000_000, 10_000_000
"""Limits of processor time [s] and of memory [byte] of a file of at most this size [byte]."""

SHARE = 1.0
"""Share of a file's repeated parts that is written."""

COLUMNS = ["voltage=u", "velocity=y", "time=t"]
COUNTS = ["voltage=u", "count=y", "time=t", "counts_per_revolution=2000"]
TOPICS = ["voltage=/u.x", "velocity=/y.x"]

Case = tuple[str, Callable[[Path], object], list[str]]
"""Name of the file, the function that writes it into an empty folder, and its mapping."""


def share(n: int) -> int:
    """Return how many of a file's parts are written."""
    return round(SHARE * n)


def text(name: str, whole: Callable[[], str], mapping: list[str] = COLUMNS) -> Case:
    """Return a file of text."""
    return name, lambda folder: (folder / name).write_text(whole()[:SIZE]), mapping


def rows(row: Callable[[int], str] = "{0},1,2".format, n: int = 2000) -> str:
    """Return a table, by its row at each number."""
    return "t,u,y\n" + "\n".join(map(row, range(n))) + "\n"


def joined(part: str, n: int) -> str:
    """Return a part with its number, so many times."""
    return ",".join(map(part.format, range(n)))


def lines(*of: str) -> str:
    """Return a text of these lines."""
    return "\n".join(of)


CSV: dict[str, Case] = {
    "400,000 columns": text("a.csv", lambda: lines(joined("c{}", 400_000), *["1," * 400_000] * 6)),
    "300,000 columns of one name": text(
        "a.csv", lambda: lines("a," * 300_000, *["1," * 300_000] * 10)
    ),
    "a line of words": text("a.txt", lambda: "word " * 2_000_000),
    "a line of words behind rows": text("a.txt", lambda: rows() + "word " * 2_000_000),
    "a line of blanks": text("a.csv", lambda: rows() + "1" + " " * SIZE),
    "lines of blanks": text("a.csv", lambda: ("[1" + " " * 99_999 + "x\n") * 100),
    "a name of brackets": text("a.csv", lambda: rows().replace("y", "y" + "[" * 5_000_000)),
    "empty lines": text("a.csv", lambda: rows() + "\n" * SIZE),
    "short rows": text("a.csv", lambda: rows("{0},1,".format, share(1_200_000))),
    "short rows and a word": text(
        "a.csv", lambda: rows("{0},1,x".format, 1) + "1,1,1\n" * share(1_600_000)
    ),
    "one column": text("a.csv", lambda: "u\n1\n" + "x\n" * 20_000 + "1\n" * 5_000_000),
    "commas": text("a.csv", lambda: rows() + ("," * 1000 + "\n") * share(10_000)),
    "labels": text("a.txt", lambda: ("a:1 " * 2000 + "\n") * 1250),
    "quotes": text("a.csv", lambda: rows() + '"' * SIZE),
    "counts near 2^60": text(
        "a.csv", lambda: rows(lambda k: f"{k},8,{k * k % 97 * 2**55}"), COUNTS
    ),
    "counts of 10^18": text(
        "a.csv", lambda: rows(lambda k: f"{k},8,{7 * k % 100 * 10**16}"), COUNTS
    ),
    "a leap of 280 years": text(
        "a.csv", lambda: rows(lambda k: f"{k + 9e9 * (k > 500)},{k % 5},2")
    ),
}

JSON: dict[str, Case] = {
    "empty lists": text("a.json", lambda: "[" + "[]," * share(3_300_000) + "[]]"),
    "empty objects": text("a.json", lambda: "[" + "{}," * share(3_300_000) + "{}]"),
    "numbers": text("a.json", lambda: "[" + "1.5," * share(2_400_000) + "1]"),
    "nested": text("a.json", lambda: "[" * SIZE),
    "many keys": text("a.json", lambda: "{" + joined('"k{}":[1,2]', share(500_000)) + "}"),
    "no common key": text("a.json", lambda: "[" + joined('{{"k{}":1}}', share(500_000)) + "]"),
    "wide rows": text("a.json", lambda: "[" + joined("[" + "1," * 50_000 + "1]", 90) + "]"),
    "lines of words": text("a.jsonl", lambda: '"a"\n' * share(2_500_000)),
    "a long number": text("a.json", lambda: '{"t":[' + "9" * 4_000_000 + ",1]}"),
    "empty tests of SysId": text(
        "a.json", lambda: '{"slow-forward":[' + "[]," * share(3_300_000) + "[]]}"
    ),
}


def sheet(part: str, *, head: str = "", repeat: str = "", times: int = 0) -> Case:
    """Return a workbook of some sound rows followed by repeated text."""
    cells = "".join(f'<c r="{c}1" t="inlineStr"><is><t>{c}</t></is></c>' for c in "TUY")
    sound = "".join(
        f'<row r="{k}"><c r="T{k}"><v>{k}</v></c><c r="U{k}"><v>{k % 5}</v></c>'
        f'<c r="Y{k}"><v>{k % 7}</v></c></row>'
        for k in range(2, 60)
    )

    def write(folder: Path) -> None:
        empty, book = io.BytesIO(), openpyxl.Workbook()
        book.save(empty)
        packed = zipfile.ZipFile(folder / "a.xlsx", "w", zipfile.ZIP_DEFLATED)
        with zipfile.ZipFile(empty) as old, packed as new:
            for item in old.infolist():
                data = old.read(item.filename)
                if item.filename != "xl/worksheets/sheet1.xml":
                    new.writestr(item.filename, data)
                    continue
                name = b"http://schemas.openxmlformats.org/spreadsheetml/2006/main"
                with new.open(item.filename, "w", force_zip64=True) as out:
                    out.write(b'<worksheet xmlns="' + name + b'">' + head.encode())
                    out.write(f'<sheetData><row r="1">{cells}</row>{sound}{part}'.encode())
                    for _ in range(share(times // 10_000)):
                        out.write(repeat.encode() * 10_000)
                    out.write(b"</sheetData></worksheet>")

    return "a.xlsx", write, ["voltage=U", "velocity=Y", "time=T"]


XLSX: dict[str, Case] = {
    "row 10^9": sheet('<row r="1000000000"><c r="T1000000000"><v>1</v></c></row>'),
    "wide rows": sheet("", repeat='<row><c r="XFD2"><v>1</v></c></row>', times=100_000),
    "a wide dimension": sheet(
        "", head='<dimension ref="A1:XFD1048576"/>', repeat="<row/>", times=100_000
    ),
    "empty cells": sheet("<row>", repeat="<c/>", times=60_000_000),
    "empty rows": sheet("", repeat="<row/>", times=40_000_000),
    "numbers": sheet("", repeat="<row><c><v>1</v></c><c><v>2</v></c></row>", times=400_000),
}

CDR, BAR = b"\0\1\0\0", "=" * 80 + "\n"
PARTS = f"B[] b\nfloat64 x\n{BAR}MSG: a/B\nC c\nC d\n{BAR}MSG: a/C\nbool[0] e\n"
FIXED = f"B[90] b\nfloat64 x\n{BAR}MSG: a/B\nC[90] c\n{BAR}MSG: a/C\nD[90] d\n"
FIXED += f"{BAR}MSG: a/D\nbool[0] e\n"
NUMBER = CDR + struct.pack("<d", 1.0)


def layout(k: int) -> bytes:
    """Return a message with two strings of individual lengths, and a number."""
    data = b""
    for length in divmod(k, 300):
        data += bytes(-len(data) % 4) + struct.pack("<I", 1 + length) + bytes(1 + length)
    return CDR + data + bytes(-len(data) % 8) + struct.pack("<d", k % 11)


def messages(
    definition: str | Callable[[int], str],
    data: Callable[[int], bytes] = lambda _: NUMBER,
    n: int = 1200,
    *,
    topics: int = 2,
    stamp: Callable[[int], int] = lambda k: 10**7 * k,
) -> Case:
    """Return an MCAP file of messages in one chunk, topic by topic in turn."""

    def write(folder: Path) -> None:
        with (folder / "a.mcap").open("wb") as file:
            writer = mcap.writer.Writer(file, chunk_size=SIZE)
            writer.start("ros2")
            names = ["/u", "/y"] if topics == 2 else [f"/t{k}" for k in range(topics)]
            keys = []
            for k, name in enumerate(names):
                own = definition if isinstance(definition, str) else definition(k)
                schema = writer.register_schema(f"a/msg/A{k}", "ros2msg", own.encode())
                keys.append(writer.register_channel(name, "cdr", schema))
            for k in range(share(n)):
                writer.add_message(keys[k % topics], stamp(k), data(k), stamp(k))
            writer.finish()

    return "a.mcap", write, TOPICS


def fields(n: int, k: int) -> str:
    """Return a definition of so many fields."""
    return "".join(f"float64 x{j}_{k}\n" for j in range(n))


MCAP: dict[str, Case] = {
    "60,000 topics": messages("float64 x\n", n=60_000, topics=60_000),
    "as many layouts as messages": messages("string a\nstring b\nfloat64 x\n", layout, 30_000),
    "no messages of their type": messages("float64 x\nfloat64 y\n", n=300_000),
    "messages of many parts": messages(
        PARTS, lambda k: CDR + struct.pack("<I", 900) + bytes(996), 9000
    ),
    "arrays of arrays": messages(FIXED, lambda k: CDR + bytes(96), 60_000),
    "a long definition": messages(partial(fields, 200_000), n=100),
    "many definitions": messages(partial(fields, 4000), topics=100),
    "a definition of empty lines": messages("\n" * 4_000_000 + "float64 x\n"),
    "a leap of 290 years": messages(
        "float64 x\n", stamp=lambda k: 10**7 * k + (2**63 - 10**11) * (k > 600)
    ),
    "stamps at both ends": messages("float64 x\n", stamp=lambda k: 10**7 * k + 2**63 * (k > 600)),
}

NAMES = "(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
TOPIC_ROWS = f"CREATE TABLE topics{NAMES}; INSERT INTO topics VALUES " + ",".join(
    f"({k}, '{name}', 'std_msgs/msg/Float64', 'cdr')" for k, name in enumerate(("/u", "/y"), 1)
)
ENDLESS = "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT id,"


def database(script: str) -> Case:
    """Return a SQLite file."""

    def write(folder: Path) -> None:
        base = sqlite3.connect(folder / "a.db3")
        base.executescript(script)
        base.close()

    return "a.db3", write, ["voltage=/u.data", "velocity=/y.data"]


SQLITE: dict[str, Case] = {
    "messages without end": database(
        f"{TOPIC_ROWS}; CREATE VIEW messages AS {ENDLESS} 1 + id % 2 AS topic_id,"
        " id * 10000000 AS timestamp, x'000100000000000000000000' AS data FROM n"
    ),
    "topics without end": database(
        f"CREATE VIEW topics AS {ENDLESS} '/u' AS name, '' AS type FROM n"
    ),
    "a column of 100 MB": database(
        f"{TOPIC_ROWS}; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp"
        " INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(100000000)) VIRTUAL);"
        "INSERT INTO messages(topic_id, timestamp) VALUES "
        + ",".join(f"({1 + k % 2},{k})" for k in range(2000))
    ),
}


def ros1_record(head: dict[str, bytes], data: bytes = b"") -> bytes:
    """Return a record of a ROS 1 bag."""
    parts = [
        struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in head.items()
    ]
    whole = b"".join(parts)
    return struct.pack("<I", len(whole)) + whole + struct.pack("<I", len(data)) + data


def connections(n: int = 30_000) -> bytes:
    """Return a connection and a message of each of many topics."""
    about = {"type": b"std_msgs/Float64", "md5sum": b"*", "message_definition": b"float64 data\n"}
    inner, parts = ros1_record(about)[4:-4], []
    for k in range(n):
        key = struct.pack("<I", k)
        parts.append(ros1_record({"op": b"\7", "conn": key, "topic": b"/t%d" % k}, inner))
        parts.append(ros1_record({"op": b"\2", "conn": key, "time": bytes(8)}, bytes(8)))
    return b"".join(parts)


def chunks(n: int = 3000) -> bytes:
    """Return chunks in chunks."""
    data = b""
    for _ in range(n):
        size = struct.pack("<I", len(data))
        data = ros1_record({"op": b"\5", "compression": b"none", "size": size}, data)
    return data


def raw(name: str, head: bytes, data: Callable[[], bytes], mapping: list[str]) -> Case:
    """Return a file of bytes."""
    return name, lambda folder: (folder / name).write_bytes((head + data())[:SIZE]), mapping


ROS1 = partial(raw, "a.bag", b"#ROSBAG V2.0\n")
LOG = partial(raw, "a.wpilog", b"WPILOG" + struct.pack("<HI", 0x0100, 0))


def entry(key: int, name: bytes, kind: bytes = b"double") -> bytes:
    """Return the record that starts an entry of a data log."""
    body = struct.pack("<BII", 0, key, len(name)) + name
    body += struct.pack("<I", len(kind)) + kind + bytes(4)
    return struct.pack("<BBBI", 0x30, 0, len(body), 0) + body


def wide_entries() -> bytes:
    """Return a log of arrays."""
    starts = b"".join(entry(k, b"u%d" % k, b"double[]") for k in range(1, 200))
    record = struct.Struct("<BBHI")
    return starts + b"".join(
        record.pack(0x34, 1 + k % 199, 512, k) + bytes(512) for k in range(share(19_000))
    )


OTHER_WRITERS: dict[str, Case] = {
    "ros1 many connections": ROS1(connections, TOPICS),
    "ros1 chunks in chunks": ROS1(chunks, TOPICS),
    "wpilog many entries": LOG(
        lambda: b"".join(entry(k % 250 + 1, b"e%d" % k) for k in range(300_000)), TOPICS
    ),
    "wpilog empty records": LOG(
        lambda: entry(1, b"u") + entry(2, b"y") + b"\0\1\0\0" * share(2_500_000), TOPICS
    ),
    "wpilog wide entries": LOG(wide_entries, TOPICS),
}


def hdf5(fill: Callable[[h5py.File], object]) -> Case:
    """Return a MATLAB file of version 7.3."""

    def write(folder: Path) -> None:
        path = folder / "a.mat"
        with h5py.File(path, "w", userblock_size=512) as file:
            fill(file)
        path.write_bytes(b"MATLAB 7.3 MAT-file" + path.read_bytes()[19:])

    return "a.mat", write, COLUMNS


def groups(file: h5py.File) -> None:
    """Nest groups, and link one to itself."""
    group: Any = file
    for _ in range(share(3000)):
        group = group.create_group("a")
    group["t"] = np.arange(3.0)
    for k in range(share(1000)):
        file[f"b{k}"] = h5py.SoftLink("/a")
        file[f"a/c{k}"] = file["a"]


def zeros(n: int, file: h5py.File, every: int = 1) -> None:
    """Declare vectors of so many zeros without storing them."""
    for k in range(every):
        file.create_dataset(f"t{k}", (n,), "f8", chunks=(10**6,))


def cells(folder: Path) -> None:
    """Write a structure whose two fields are the same structure, and so on."""
    value: Any = np.arange(3.0)
    for _ in range(share(2**15).bit_length() - 1):
        value = {"a": value, "b": value}
    scipy.io.savemat(folder / "a.mat", {"t": value}, do_compression=True)


MAT: dict[str, Case] = {
    "groups": hdf5(groups),
    "10^13 zeros": hdf5(partial(zeros, 10**13)),
    "a thousand times 10^8 zeros": hdf5(lambda file: zeros(10**8, file, 1000)),
    "12,000 variables": hdf5(
        lambda f: [f.create_dataset(f"t{k}", data=[1.0, 2]) for k in range(share(12_000))]
    ),
    "cells in cells": ("a.mat", cells, COLUMNS),
}


def metadata(*parts: Callable[[], str] | str) -> Case:
    """Return a bag by its metadata."""

    def write(folder: Path) -> None:
        whole = "".join(part if isinstance(part, str) else part() for part in parts)
        (folder / "metadata.yaml").write_text(whole[:SIZE])
        messages("float64 x\n")[1](folder)

    return "", write, TOPICS


def aliases() -> str:
    """Return ten lines that expand to 10^9 words."""
    inner = [",".join([f"*a{k - 1}" if k else "lol"] * 10) for k in range(9)]
    return lines(*(f"a{k}: &a{k} [{one}]" for k, one in enumerate(inner)), "")


INFORMATION = "rosbag2_bagfile_information:\n  relative_file_paths: "
BAG: dict[str, Case] = {
    "paths of aliases": metadata(aliases, INFORMATION, "[*a8]"),
    "a topic of aliases": metadata(
        aliases,
        INFORMATION,
        "[a.mcap]\n  topics_with_message_count:\n"
        "    - {topic_metadata: {name: *a8}, message_count: 1}",
    ),
    "many paths": metadata(INFORMATION, lambda: "\n  - a" * 1_500_000),
    "nested": metadata("[" * 5_000_000),
}


def links(folder: Path) -> None:
    """Write a folder with three links to itself."""
    (folder / "log.csv").write_text(rows())
    for name in "abc":
        (folder / name).symlink_to(folder, target_is_directory=True)


def folders(folder: Path) -> None:
    """Write a folder in a folder, and so on."""
    path = folder
    for _ in range(1500):
        path = path / "a"
        path.mkdir()
    (path / "log.csv").write_text(rows())


def pipe(name: str, whole: bool = False) -> Case:
    """Return a pipe that nobody writes into, or the folder where it lies."""
    return "" if whole else name, lambda folder: os.mkfifo(folder / name), COLUMNS


def zero(name: str) -> Case:
    """Return a link to a device without end."""
    return name, lambda folder: (folder / name).symlink_to("/dev/zero"), COLUMNS


PLACES: dict[str, Case] = {
    "links to itself": ("", links, COLUMNS),
    "1500 folders": ("", folders, COLUMNS),
    "pipe": pipe("a.csv"),
    "pipe inside": pipe("a.csv", whole=True),
    "pipe as metadata": pipe("metadata.yaml", whole=True),
    "device": zero("a.csv"),
    "device called a MATLAB file": zero("a.mat"),
}
KINDS = dict(csv=CSV, json=JSON, xlsx=XLSX, mcap=MCAP, sqlite=SQLITE, mat=MAT, bag=BAG)
CASES: dict[str, Case] = {
    **{f"{kind}: {name}": case for kind, some in KINDS.items() for name, case in some.items()},
    **OTHER_WRITERS,
    **PLACES,
}


@cache
def reader() -> subprocess.Popen[str]:
    """Start the process whose children read."""
    script = [sys.executable, str(Path(__file__).with_name("hostile_reader.py"))]
    return subprocess.Popen(script, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def read(name: str) -> tuple[list[str], float, str]:
    """Return the output lines of a case, the memory [byte] it took, and its fault."""
    target, write, mapping = CASES[name]
    folder = Path(tempfile.mkdtemp())
    try:
        write(folder)
        asked = json.dumps([str(folder / target), mapping, 8 * MEMORY, 3 * SECONDS])
        server = reader()
        assert server.stdin and server.stdout
        print(asked, file=server.stdin, flush=True)
        out, err, code, kilobytes = json.loads(server.stdout.readline())
    finally:
        subprocess.run(["rm", "-r", folder], check=True)  # deeper than Python removes
    told, memory = out.splitlines(), 1024.0 * kilobytes
    wrong = [f"ends with {code}"] if code else []
    wrong += err.strip().splitlines()[-1:]
    wrong += ["too slow"] if any(float(line.split()[0]) > SECONDS for line in told) else []
    wrong += ["too large"] if memory > MEMORY else []
    wrong += ["too long"] if any(len(line) > 2000 for line in told) else []
    calls = 1 if told and "is not read after" in told[0] else 2
    wrong += ["not one line each"] if len(told) != calls else []
    return told, memory, "; ".join(wrong)


def main(names: Iterable[str]) -> int:
    """Read cases; exit code 1 where one is not within its bounds."""
    failed = 0
    for name in names:
        told, memory, wrong = read(name)
        short = " | ".join(line[:100] for line in told)
        print(
            f"{name:34} {memory / 1e6:5.0f} MB  {short}  {wrong and 'FAILS: ' + wrong}", flush=True
        )
        failed += bool(wrong)
    print(f"{failed} fail")
    return 1 if failed else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=list(CASES))
    sys.exit(main(parser.parse_args().names))
