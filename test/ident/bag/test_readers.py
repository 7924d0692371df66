# SPDX-License-Identifier: Apache-2.0
"""Formats other than ROS 2 bags, from files written by other software."""

import io
import json
import struct
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import openpyxl
import pytest
import scipy.io
from recordings import assert_refused
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from smp_motor_ident.bag import list_topics, read_records
from smp_motor_ident.bag.readers import FORMATS
from smp_motor_ident.errors import BagError

N = 200
TIME = 0.01 * np.arange(N)
RNG = np.random.default_rng(3)
VOLTAGE = RNG.uniform(-6, 6, N)
SPEED = np.cumsum(RNG.normal(0, 1, N))
MAP = ["voltage=u velocity=y time=t"]


def assert_motor(record: Any, n: int = N, speed: np.ndarray = SPEED) -> None:
    """Assert that a record has the signals, with commands held from their stamps on."""
    assert len(record) == n
    np.testing.assert_allclose(record.time, TIME[:n], atol=1e-9)  # whole nanoseconds
    # Excel keeps 16 digits.
    np.testing.assert_allclose(record.voltage[1:], VOLTAGE[: n - 1], rtol=1e-15)
    np.testing.assert_allclose(
        record.velocity, speed[:n], rtol=1e-15
    )  # rounding of one unit factor


def test_every_format_is_registered_once():
    names = [form.name for form in FORMATS]
    assert len(names) == len(set(names)) >= 9


@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_vectors_are_read_as_columns(tmp_path, compressed):
    path = tmp_path / "log.mat"
    content = {"t": TIME, "u": VOLTAGE[:, None], "y": SPEED, "note": "a motor", "fs": 100.0}
    scipy.io.savemat(path, content, do_compression=compressed)
    assert_motor(read_records(path, MAP)["motor"])


def test_matlab_structure_fields_and_matrix_columns_are_addressed_by_path(tmp_path):
    path = tmp_path / "log.mat"
    log = {"time": TIME, "signals": {"values": np.stack([VOLTAGE, SPEED], axis=1)}}
    scipy.io.savemat(path, {"log": log}, do_compression=True)
    mapping = ["voltage=log.signals.values[0] velocity=log.signals.values[1]:rad/s time=log.time"]
    assert_motor(read_records(path, mapping)["motor"])


def test_simulink_scope_signals_and_cells_are_addressed_by_index(tmp_path):
    path = tmp_path / "log.mat"
    kinds = [("values", object), ("dimensions", object), ("label", object)]
    signals = np.array([(VOLTAGE, 1, "u"), (SPEED, 1, "w")], dtype=kinds)
    cells = np.array([VOLTAGE, SPEED[:-1]], dtype=object)
    scipy.io.savemat(path, {"scope": {"time": TIME, "signals": signals}, "cells": cells})
    mapping = "velocity=scope.signals[1].values:rad/s time=scope.time voltage="
    for voltage in ("scope.signals[0].values", "cells[0]"):
        assert_motor(read_records(path, [mapping + voltage])["motor"])


def matlab_object(name: str, kind: str, order: str = "<") -> bytes:
    """Return an object as MATLAB saves it: texts and references, without dimensions."""

    def element(number: int, body: bytes) -> bytes:
        return struct.pack(order + "II", number, len(body)) + body + bytes(-len(body) % 8)

    def small(body: bytes) -> bytes:
        return struct.pack(order + "I", len(body) << 16 | 1) + body.ljust(4, b"\0")

    shape = element(5, struct.pack(order + "2i", 6, 1))
    numbers = struct.pack(order + "6I", 0xDD000000, 2, 1, 1, 1, 28)
    header = element(6, struct.pack(order + "2I", 13, 0))
    references = element(14, header + shape + element(1, b"") + element(6, numbers))
    flags = element(6, struct.pack(order + "2I", 17, 0))
    texts = element(1, name.encode()) + small(b"MCOS") + element(1, kind.encode())
    return element(14, flags + texts + references)


@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_objects_are_reported_and_other_variables_read(tmp_path, compressed):
    path = tmp_path / "log.mat"
    scipy.io.savemat(path, {"t": TIME, "u": VOLTAGE, "y": SPEED}, do_compression=compressed)
    one, two = matlab_object("speedSeries", "timeseries"), matlab_object("out", "Simulink.Data")
    if compressed:
        packed = [zlib.compress(one), zlib.compress(two)]
        one, two = (struct.pack("<II", 15, len(data)) + data for data in packed)
    whole = path.read_bytes()
    path.write_bytes(whole[:128] + one + whole[128:] + two)
    record = read_records(path, MAP)["motor"]
    assert_motor(record)
    (said,) = [f.message for f in record.findings if f.code == "matlab_object"]
    assert "speedSeries (timeseries), out (Simulink.Data)" in said
    path.write_bytes(whole[:128] + one)
    with pytest.raises(BagError, match=r"speedSeries \(timeseries\); save its Time and Data as"):
        list_topics(path)


def test_matlab_7_3_objects_are_reported_and_other_variables_read(tmp_path):
    path = tmp_path / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in {"t": TIME, "u": VOLTAGE, "y": SPEED}.items():
            file[name] = values[None]
        file["data"] = np.array([[0xDD000000, 2, 1, 1, 1, 2]], dtype=np.uint32)
        file["data"].attrs["MATLAB_class"] = np.bytes_("Simulink.SimulationData.Dataset")
        file["data"].attrs["MATLAB_object_decode"] = np.int32(3)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    record = read_records(path, MAP)["motor"]
    assert_motor(record)
    (said,) = [f.message for f in record.findings if f.code == "matlab_object"]
    assert "data (Simulink.SimulationData.Dataset)" in said


def test_signals_in_rows_of_matlab_4_file_are_read(tmp_path):
    path = tmp_path / "log.mat"
    content = {"data": np.stack([TIME, VOLTAGE, SPEED]), "note": "QUARC", "fs": np.float32(100)}
    scipy.io.savemat(path, content, format="4")
    assert_motor(
        read_records(path, ["voltage=data[1] velocity=data[2]:rad/s time=data[0]"])["motor"]
    )
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(BagError, match=r"log\.mat: no readable MATLAB file"):
        list_topics(path)


def test_invalid_or_truncated_matlab_file_is_refused(tmp_path):
    hdf = tmp_path / "new.mat"
    hdf.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n")
    assert_refused(r"h5py|no readable MATLAB", hdf, MAP)
    whole = io.BytesIO()
    scipy.io.savemat(whole, {"t": TIME, "u": VOLTAGE, "y": SPEED}, do_compression=True)
    (tmp_path / "cut.mat").write_bytes(whole.getvalue()[:700])
    assert_refused(r"cut\.mat: .*cut off", tmp_path / "cut.mat", MAP)


ENTRIES = ("/drive/left volts", "NT:left/speed")


def data_log(extra=b"", metadata="", speed=SPEED, names=ENTRIES):
    """Return a data log of the published layout, with narrow and wide records."""

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    def record(entry: int, stamp: int, payload: bytes, wide: bool) -> bytes:
        if wide:
            return struct.pack("<BIIQ", 0x7F, entry, len(payload), stamp) + payload
        return struct.pack("<BBBI", 0x30, entry, len(payload), stamp) + payload

    parts = [b"WPILOG", struct.pack("<HI", 0x0100, len(extra)), extra]
    for entry, (name, kind) in enumerate(
        zip((*names, "message"), ("double", "double[]", "string")), 1
    ):
        stated = metadata if entry == 2 else ""
        start = struct.pack("<BI", 0, entry) + text(name) + text(kind) + text(stated)
        parts.append(record(0, 0, start, wide=False))
    for k in range(N):
        stamp = round(1e6 * TIME[k])
        parts.append(record(1, stamp, struct.pack("<d", VOLTAGE[k]), wide=k % 2 == 0))
        parts.append(record(2, stamp, struct.pack("<dd", 7.0, speed[k]), wide=False))
        parts.append(record(3, stamp, b"hello", wide=True))
    return b"".join(parts)


def test_entries_of_a_wpilib_data_log_are_signals_with_their_own_times(tmp_path):
    path = tmp_path / "robot.wpilog"
    path.write_bytes(data_log(b"extra header"))
    mapping = ['voltage="/drive/left volts"', 'velocity="NT:left/speed[1]"']
    assert_motor(read_records(path, mapping)["motor"])
    assert [info.topic for info in list_topics(path)[0].topics] == [
        "/drive/left volts",
        "NT:left/speed",
    ]


@pytest.mark.parametrize(
    ("metadata", "radius", "factor"),
    [
        ("Rotation per Second", "", 2 * np.pi), ("turns_per_second", "", 2 * np.pi),
        ("Meter per Second", " wheel_radius=0.05", 20.0),
        ("meters_per_second", " wheel_radius=0.05", 20.0),
        ('{"source":"AdvantageKit","unit":"radians per second"}', "", 1.0),
        ('{"source":"NT"}', "", 1.0), ("[[[{", "", 1.0), ("RPM", "", np.pi / 30),
    ],
)  # fmt: skip
def test_unit_in_wpilib_metadata_is_applied(tmp_path, metadata, radius, factor):
    """The classes SysIdRoutineLog of Java and of C++ write such metadata."""
    path = tmp_path / "robot.wpilog"
    names = ("voltage-left-drive", "velocity-left-drive")
    path.write_bytes(data_log(b"", metadata, SPEED / factor, names))
    mapping = [f'voltage="{names[0]}" velocity="{names[1]}[1]"{radius}']
    record = read_records(path, mapping)["motor"]
    np.testing.assert_allclose(record.velocity, SPEED, rtol=1e-12)


def test_truncated_wpilib_data_log_is_read_up_to_the_cut(tmp_path):
    path = tmp_path / "robot.wpilog"
    whole = data_log()
    path.write_bytes(whole[: len(whole) // 2])
    mapping = ['voltage="/drive/left volts" velocity="NT:left/speed[1]"']
    record = read_records(path, mapping)["motor"]
    assert 80 < len(record) < 120
    np.testing.assert_array_equal(record.velocity, SPEED[: len(record)])
    assert [f.code for f in record.findings if f.severity == "warning"] == ["damaged_recording"]


TESTS = ("slow-forward", "slow-backward", "fast-forward", "fast-backward")


def write_sysid(path: Path, columns: list[np.ndarray], **keys: object) -> Path:
    """Write a SysId file as documented, with a quarter of the rows in each test."""
    rows = np.array_split(np.stack(columns, axis=1), 4)
    tests = {test: some.tolist() for test, some in zip(TESTS, rows)}
    path.write_text(json.dumps({"sysid": True, "test": "Simple", **tests, **keys}))
    return path


TURNS = np.cumsum(SPEED) * np.diff(TIME, prepend=0) / (2 * np.pi)  # of the output
RATE = SPEED / (2 * np.pi)  # rotations per second


@pytest.mark.parametrize(
    ("units", "per_rotation", "mapping"),
    [
        ("Rotations", 1.0, None),
        ("Radians", 2 * np.pi, None),
        ("Degrees", 360.0, None),
        ("Meters", 2 * np.pi * 0.076, ["wheel_radius=0.076"]),
        ("Feet", 2 * np.pi * 0.076 / 0.3048, ["wheel_radius=0.076"]),
        ("Inches", 2 * np.pi * 0.076 / 0.0254, ["wheel_radius=0.076"]),
    ],
)
def test_sysid_rotations_are_converted_to_radians(tmp_path, units, per_rotation, mapping):
    # docs/data-collection.md: "all positions and velocities should be in rotations"
    path = tmp_path / "sysid.json"
    write_sysid(path, [TIME, VOLTAGE, TURNS, RATE], units=units, unitsPerRotation=per_rotation)
    record = read_records(path, mapping)["motor"]
    np.testing.assert_allclose(record.velocity, SPEED, rtol=1e-12)
    np.testing.assert_allclose(record.position, 2 * np.pi * TURNS, atol=1e-9)


def test_each_test_of_sysid_is_a_segment(tmp_path):
    time = TIME + 10.0 * np.repeat(np.arange(4), N // 4)
    path = tmp_path / "sysid.json"
    write_sysid(path, [time, VOLTAGE, TURNS, RATE], units="Rotations", unitsPerRotation=1.0)
    assert read_records(path)["motor"].starts == tuple(range(0, N, N // 4))


@pytest.mark.parametrize(("units", "wrong"), [("Rotations", 0.471), ("Radians", 1.0)])
def test_units_per_rotation_contradicting_the_unit_are_reported_and_ignored(tmp_path, units, wrong):
    """wpilibsuite/sysid issue 319: 1 rotation = 0.471 rotations."""
    path = tmp_path / "sysid.json"
    write_sysid(path, [TIME, VOLTAGE, TURNS, RATE], units=units, unitsPerRotation=wrong)
    record = read_records(path)["motor"]
    np.testing.assert_allclose(record.velocity, SPEED, rtol=1e-12)
    (finding,) = (f for f in record.findings if f.code == "units_per_rotation")
    assert finding.severity == "warning" and f"says {wrong:g}" in finding.message


def write_drivetrain(path: Path) -> Path:
    """Write a SysId file of a drivetrain whose wheels have a radius of 50 mm."""
    sides = [VOLTAGE, -VOLTAGE, TURNS, -TURNS, RATE, -RATE]
    columns = [TIME, *sides, np.zeros(N), np.zeros(N)]
    keys = {"test": "Drivetrain", "units": "Meters", "unitsPerRotation": 2 * np.pi * 0.05}
    return write_sysid(path, columns, **keys)


def test_sysid_drivetrain_in_metres_requires_only_wheel_radius(tmp_path):
    path = write_drivetrain(tmp_path / "sysid.json")
    assert_refused("give --map wheel_radius=METRES", path)
    records = read_records(path, ["wheel_radius=0.05"])
    np.testing.assert_allclose(records["left"].velocity, SPEED, atol=1e-9)
    np.testing.assert_allclose(records["right"].velocity, -SPEED, atol=1e-9)
    np.testing.assert_allclose(records["right"].voltage[1:], -VOLTAGE[:-1])
    apart = read_records(path, ["wheel_radius=0.05", "right.wheel_radius=0.1"])
    np.testing.assert_allclose(apart["left"].velocity, SPEED, atol=1e-9)
    np.testing.assert_allclose(apart["right"].velocity, -0.5 * SPEED, atol=1e-9)


def test_the_suggestion_for_a_drivetrain_in_metres_requests_the_radius(tmp_path):
    path = write_drivetrain(tmp_path / "sysid.json")
    listing = list_topics(path)[0]
    assert "left.velocity=left_velocity:m/s" in listing.suggestion
    assert [text.partition("=")[0] for text in listing.asked] == ["wheel_radius"]
    assert listing.remark == "the file says this itself: wheel_radius alone is enough"
    records = read_records(path, [*listing.suggestion, "wheel_radius=0.05"])
    np.testing.assert_allclose(records["left"].velocity, SPEED, atol=1e-9)


@pytest.mark.parametrize("keys", [{}, {"units": "Radians"}])
def test_frc_characterization_rows_of_six_columns_are_read(tmp_path, keys):
    # frc-characterization, arm-characterization/data_analyzer.py of 2019: ``columns``
    path = tmp_path / "arm.json"
    battery, speed = np.full(N, 12.5), VOLTAGE / 12.5
    write_sysid(
        path, [TIME, battery, speed, VOLTAGE, TURNS, SPEED], sysid=False, test="Arm", **keys
    )
    mapping = None if keys else ["voltage=voltage velocity=velocity time=time"]
    record = read_records(path, mapping)["motor"]
    np.testing.assert_allclose(record.velocity, SPEED)
    np.testing.assert_allclose(record.voltage[1:], VOLTAGE[:-1])


def test_frc_characterization_mechanism_is_read_from_left_columns(tmp_path):
    # frc-characterization, Robot.java.mako since April 2020: ten columns in rotations
    path = tmp_path / "simple.json"
    zero = np.zeros(N)
    columns = [TIME, zero, zero, VOLTAGE, VOLTAGE, TURNS, TURNS, RATE, RATE, zero]
    write_sysid(path, columns, sysid=False, test="Simple", units="Degrees", unitsPerRotation=360.0)
    records = read_records(path)
    assert list(records) == ["motor"]
    np.testing.assert_allclose(records["motor"].velocity, SPEED, rtol=1e-12)


@pytest.mark.parametrize("form", ["rows", "columns", "lines", "nested"])
def test_json_logs_of_any_shape_are_read(tmp_path, form):
    rows = [
        {"t": t, "u": u, "y": y, "state": "run"}
        for t, u, y in zip(TIME.tolist(), VOLTAGE.tolist(), SPEED.tolist())
    ]
    path, mapping = tmp_path / "log.json", MAP
    if form == "rows":
        path.write_text(json.dumps(rows))
    elif form == "columns":
        columns = {"t": TIME.tolist(), "u": VOLTAGE.tolist(), "y": SPEED.tolist()}
        path.write_text(json.dumps(columns))
    elif form == "lines":
        path = tmp_path / "log.jsonl"
        path.write_text("\n".join(map(json.dumps, rows)) + '\n{"t": 2.0, "u"')
    else:
        nested = [{"at": r["t"], "motor": {"u": r["u"], "w": [0, r["y"]]}} for r in rows]
        path.write_text(json.dumps({"rig": 1, "log": nested}))
        mapping = ["voltage=log.motor.u velocity=log.motor.w[1] time=log.at"]
    record = read_records(path, mapping)["motor"]
    assert_motor(record)
    assert any(f.code == "damaged_recording" for f in record.findings) is (form == "lines")


def test_jsonl_of_interleaved_message_kinds_is_read(tmp_path):
    path = tmp_path / "log.jsonl"
    lines = []
    for t, u, y in zip(TIME.tolist(), VOLTAGE.tolist(), SPEED.tolist()):
        lines += [json.dumps({"t": t, "cmd": u}), json.dumps({"t": t + 0.005, "rpm": y})]
    path.write_text("\n".join(lines))
    record = read_records(path, ["voltage=cmd velocity=rpm:rpm time=t"])["motor"]
    assert record.velocity is not None and len(record) >= N - 1
    seen = record.velocity[np.isfinite(record.velocity)] * 60 / (2 * np.pi)
    np.testing.assert_allclose(seen, SPEED[-seen.size :], rtol=1e-12)


def test_a_workbook_is_read_with_names_and_units(tmp_path):
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(["measured on Monday"])
    sheet.append(["t", "u", "y", "remark"])
    sheet.append(["ms", "V", "rad/s", None])
    for t, u, y in zip(TIME, VOLTAGE, SPEED):
        sheet.append([1e3 * t, u, y, "ok"])
    book.save(tmp_path / "log.xlsx")
    assert_motor(read_records(tmp_path / "log.xlsx", MAP)["motor"])


def test_longest_sheet_of_workbook_is_read(tmp_path):
    book = openpyxl.Workbook()
    for row in (["sensor", "Hz", "ms"], ["gyro", 8000, 0.125], ["compass", 200, 5]):
        book.active.append(row)
    sheet = book.create_sheet("measured")
    for row in (["t", "u", "y"], *zip(TIME, VOLTAGE, SPEED)):
        sheet.append(list(row))
    book.save(tmp_path / "log.xlsx")
    assert_motor(read_records(tmp_path / "log.xlsx", MAP)["motor"])


def write_ros1_bag(path: Path, compression: Any = None) -> Path:
    """Write a ROS 1 bag with rosbags."""
    store = get_typestore(Stores.ROS1_NOETIC)
    number, joints = "std_msgs/msg/Float64", "sensor_msgs/msg/JointState"
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    writer = Writer(path)
    writer.chunk_threshold = 4096
    if compression is not None:
        writer.set_compression(compression)
    with writer as bag:
        pwm = bag.add_connection("/pwm", number, typestore=store)
        state = bag.add_connection("/joint_states", joints, typestore=store)
        for k in range(N):
            at = 1_600_000_000_000_000_000 + round(1e9 * TIME[k])
            message: Any = store.types[number](float(VOLTAGE[k]))
            bag.write(pwm, at, store.serialize_ros1(message, number))
            message = store.types[joints](
                header(k, stamp(*divmod(at, 10**9)), "base"),
                ["left", "right"],
                np.zeros(2),
                np.array([0.0, SPEED[k]]),
                np.zeros(0),
            )
            bag.write(state, at, store.serialize_ros1(message, joints))
    return path


ROS1 = ["voltage=/pwm.data velocity=/joint_states.velocity[right] clock=log"]


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_ros1_bag_is_read_without_conversion(tmp_path, compression):
    kind = None if compression is None else Writer.CompressionFormat[compression]
    assert_motor(read_records(write_ros1_bag(tmp_path / "old.bag", kind), ROS1)["motor"])


def test_truncated_ros1_bag_is_read_up_to_the_cut(tmp_path):
    path = write_ros1_bag(tmp_path / "old.bag")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 5])
    record = read_records(path, ROS1)["motor"]
    assert N // 4 < len(record) < N
    np.testing.assert_array_equal(record.velocity, SPEED[: len(record)])
    assert any(f.code == "damaged_recording" for f in record.findings)


def test_number_formats_of_workbook_are_applied(tmp_path):
    # ECMA-376, 18.8.30: a percentage shows a hundred times the stored value; times are
    # parts of a day
    book = openpyxl.Workbook()
    book.active.append(["time", "duty", "speed"])
    for k in range(N):
        book.active.append([(TIME[k] + 3600 * 25) / 86_400, VOLTAGE[k] / 12, SPEED[k]])
        book.active.cell(k + 2, 1).number_format = "[h]:mm:ss.000"
        book.active.cell(k + 2, 2).number_format = "0.0%"
    book.save(tmp_path / "log.xlsx")
    mapping = ["voltage=duty velocity=speed time=time supply_voltage=12"]
    record = read_records(tmp_path / "log.xlsx", mapping)["motor"]
    np.testing.assert_allclose(record.velocity, SPEED)
    np.testing.assert_allclose(record.voltage[1:], VOLTAGE[:-1])
    np.testing.assert_allclose(record.time, TIME, atol=1e-6)
