# SPDX-License-Identifier: Apache-2.0
"""CSV files of different software are read with the same mapping."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from recordings import assert_refused, codes, follow, notes, read_one, read_table, write_table

from smp_motor_ident.bag import list_topics, read_experiments, read_records

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
T = 0.02 * np.arange(5)
U = np.array([1.0, -2.0, 3.0, 4.5, 0.0])
Y = np.array([0.0, 90.0, 180.0, -90.0, 45.0])
MAP = ["voltage=u velocity=y:deg/s time=t"]


def table(separator=",", decimal=".", head="t,u,y", newline="\n"):
    rows = [head.replace(",", separator)]
    rows += [separator.join(f"{x:.6f}".replace(".", decimal) for x in row) for row in zip(T, U, Y)]
    return newline.join(rows) + newline


def lines(row: str, head: str = "t,u,y", times: Sequence[object] = T) -> str:
    """Return the samples as a program prints them."""
    return "\n".join([head, *(row.format(t, u, y) for t, u, y in zip(times, U, Y))])


def case(text: str | bytes, mapping: str = MAP[0], **other: np.ndarray) -> object:
    """Return a text, its mapping, and the time [s], voltage [V] and speed [rad/s] it states."""
    encoded = text if isinstance(text, bytes) else text.encode()
    return encoded, mapping, {"time": T, "voltage": U, "velocity": np.deg2rad(Y), **other}


SECONDS = np.arange(5.0)
IN_UNITS = {"time": 1e-6 * T, "voltage": 1e-3 * U}
USUAL = [
    table(), table(newline="\r\n"), table(";", ","), table("\t"), table(" "), table(", "),
    "\ufeff" + table(), "# made by a scope\n#\n" + table() + "\n# the end\n",
    table(head='"t","u","y"'), re.sub(r"(?m)^(.+)$", r'"\1"', table(", ")),
    re.sub(r"(?m)^(\d.+)$", r'"\1"', table()), re.sub(r"(?m)^(.+)$", r'"\1"', table("\t")),
    re.sub(r"([^,\n]+)", r'"\1"', table()),
    table(", ", head="t, u, y") + "Acceleration: 9.46\n",
    lines("[{}, {}, {}]"),  # Python lists
    lines("{} {} {};", "t u y").replace("0.0", "[0.0", 1) + "\n];",  # a MATLAB matrix
    lines("{},{},{};").replace("0.0", "[0.0", 1) + "\n];",
    lines("{:f}   {:f}   {:f}", "t     u     y").replace(".", ","),
    lines("t:{},u:{},y:{}", ""), lines("t: {}\tu: {}\ty: {}", ""),  # a serial plotter
    lines("t={} u={} y={}", ""), lines("t,{},u,{},y,{}", "log of 2024"),
    lines("t: {}s, u: {}V, y: {}deg/s", "C.07A, y: 3"),
]  # fmt: skip
STATED = [
    *map(case, USUAL),
    *(case(table(head="t,u,y [°/s]").encode(coding), 'voltage=u velocity="y [°/s]":deg/s time=t')
      for coding in ("utf-8", "utf-16", "latin-1")),
    *(case("\n".join(f"12:00:0{k}.500 -> {row.format(u, y)}" for k, (u, y) in enumerate(zip(U, Y))),
           "time={} voltage={} velocity={}:deg/s".format(*names), time=SECONDS)
      for row in ("{},{}", "{} {}", "{}\t{}", "u:{},y:{}", "u={} y={}")
      for names in [("time", "u", "y") if "u" in row else ("c1", "c2", "c3")]),
    *(case(lines("2024-05-06" + between + "12:00:0{},{},{}", times=range(5)), time=SECONDS)
      for between in "T _."),
    *(case(lines("{}, {}, {}" + end, "", times=range(0, 100, 20)).strip("\n"),
           "time=c1:ms voltage=c2 velocity=c3:deg/s")
      for end in (";", " ;", ";\r")),
    case(lines("{},{}%,{}"), MAP[0] + " supply_voltage=12", voltage=0.12 * U),
    case(lines("{}:00:00.5,{},{}", times=range(25, 30)), MAP[0] + " gap=7200", time=3600 * SECONDS),
    case("# t,u,y\n# s,mV,deg/s\n" + table().partition("\n")[2], "voltage=u velocity=y time=t",
         voltage=1e-3 * U),
    case(table(), "voltage=u velocity=y:deg/s sample_time=0.5", time=0.5 * SECONDS),
    *(case(table(head=names), 'time="{}" '.format(names.split(",")[0]) + mapping.format(
           *(f'"{name}"' for name in names.split(",")[1:])), **IN_UNITS, velocity=speed)
      for names in ("t_us,u_mV,y_rpm", "micros,u mV,rpm", "t [us],u [mV],y [rpm]")
      for mapping, speed in (("voltage={} velocity={}", Y * np.pi / 30),
                             ("voltage={}*1e-3 velocity={}:deg/s", np.deg2rad(Y)))),
]  # fmt: skip


@pytest.mark.parametrize(("text", "mapping", "stated"), STATED)
def test_csv_dialects_units_and_time_formats_are_read(tmp_path, text, mapping, stated):
    path = tmp_path / "log.csv"
    path.write_bytes(text)
    record = read_records(path, [mapping])["motor"]
    assert record.time[0] == 0.0
    np.testing.assert_allclose(record.time, stated["time"], atol=1e-9)
    np.testing.assert_allclose(np.diff(record.time), np.diff(stated["time"]))
    np.testing.assert_allclose(record.velocity, stated["velocity"])
    # A command holds from its row on: the interval that ends at a row has the previous one.
    np.testing.assert_allclose(record.voltage[1:], stated["voltage"][:-1])
    strays = "stray_rows" in [f.code for f in record.findings]
    assert strays or b"Acceleration" not in text


@pytest.mark.parametrize(
    ("above", "separator", "names"),
    [
        ("# t,u,y", ",", ["t", "u", "y"]), ("# time, u, w", ",", ["time", "u", "w"]),
        ("# t u y", " ", ["t", "u", "y"]), ("# t, u, y", " ", ["t", "u", "y"]),
        ("%t\tu\ty", "\t", ["t", "u", "y"]), ("// t;u;y", ";", ["t", "u", "y"]),
        ("# made by a scope\n# 24 V, at rest\n## t, u, y", ",", ["t", "u", "y"]),
        ("# t,u,y\n# s,mV,deg/s", ",", ["t", "u", "y"]),
        ('# "t [s]","u","y"', ",", ["t [s]", "u", "y"]),
        ("# made by scope", ",", ["c1", "c2", "c3"]), ("# t,u", ",", ["c1", "c2", "c3"]),
        ("# t,,y", ",", ["c1", "c2", "c3"]), ("# 0.0,1.0,2.0", ",", ["c1", "c2", "c3"]),
        ("# a,b,c\nt,u,y", ",", ["t", "u", "y"]),
    ],
)  # fmt: skip
def test_column_names_are_read_from_comment_above_the_data(tmp_path, above, separator, names):
    path = tmp_path / "log.csv"
    path.write_text(above + "\n" + table(separator).partition("\n")[2])
    listing = list_topics(path)[0]
    assert listing.topics[0].fields == names
    unnamed = "no_column_names" in [finding.code for finding in listing.findings]
    assert unnamed is (names[0] == "c1")
    record = read_records(path, [f"voltage={names[1]}:V velocity={names[2]}:deg/s sample_time=1"])
    np.testing.assert_allclose(record["motor"].velocity, np.deg2rad(Y))


@pytest.mark.parametrize(
    ("head", "names"),
    [
        ("Time   Commanded Pos   Encoder 1", ["Time", "Commanded Pos", "Encoder 1"]),
        ("Time Commanded Pos Encoder 1", ["c1", "c2", "c3"]),
    ],
)
def test_column_names_of_several_words_stay_aligned(tmp_path, head, names):
    (tmp_path / "log.txt").write_text(head + "\n" + table(" ").partition("\n")[2])
    assert list_topics(tmp_path / "log.txt")[0].topics[0].fields == names


@pytest.mark.parametrize("output", ["velocity", "position", "count"])
@pytest.mark.parametrize("lead", [False, True])
def test_hold_of_voltage_is_inferred_from_motion(tmp_path, lead, output):
    rng = np.random.default_rng(1)
    volts = np.repeat(rng.uniform(-6, 6, 30), 20)
    speed = follow(np.append(volts[1:], 0.0) if lead else volts)
    motion = speed + rng.normal(0, 0.3, speed.size)
    if output != "velocity":
        motion = np.rint(10 * np.cumsum(speed))
    columns, mapping = (
        dict(t=0.01 * np.arange(600), u=volts, y=motion),
        [f"voltage=u {output}=y time=t"],
    )
    record = read_table(tmp_path, mapping, **columns)
    assert ("held_before" in codes(record)) is lead
    np.testing.assert_allclose(record.voltage[1:], volts[1:] if lead else volts[:-1])
    given = read_table(tmp_path, [*mapping, "held=after"], **columns)
    np.testing.assert_allclose(given.voltage[1:], volts[:-1])


@pytest.mark.parametrize("noise", [0.3, 3.0])
def test_feedback_is_not_mistaken_for_voltage_held_before_its_row(tmp_path, noise):
    """A controller's command follows the speed of its row; the speed does not follow it."""
    rng = np.random.default_rng(2)
    target = np.repeat(rng.uniform(-100, 100, 30), 20)
    rows, speed, integral = [], 0.0, 0.0
    for goal in target:
        measured = speed + rng.normal(0, noise)
        integral += 0.002 * (goal - measured)
        volts = round(0.02 * (goal - measured) + integral, 1)
        rows.append((volts, measured))
        speed += (1 - np.exp(-0.1)) * (20 * volts - speed)
    u, y = zip(*rows)
    record = read_table(
        tmp_path, ["voltage=u velocity=y time=t"], t=0.01 * np.arange(600), u=u, y=y
    )
    assert "held_before" not in codes(record)


def test_empty_cells_are_missing_values(tmp_path):
    k = range(100)
    columns = dict(
        t=0.01 * np.arange(100), u=k, y=[n if n % 10 else "" for n in k], i=100 * ["nan"]
    )
    record = read_table(tmp_path, ["voltage=u velocity=y current=i time=t"], **columns)
    assert np.isnan(record.velocity).sum() == 10
    assert record.current is None
    assert "velocity: 10 values missing" in notes(record)


@pytest.mark.parametrize(("step", "unit"), [(20, "ms"), (5180, "us")])
def test_unit_of_time_that_cannot_be_seconds_is_requested(tmp_path, step, unit):
    k = np.arange(99)
    path = write_table(tmp_path / "log.csv", tiempo=step * k, u=k % 7, y=k % 5)
    assert_refused(
        f"rises by {step} per row.* time=tiempo:ms", path, ["voltage=u velocity=y time=tiempo"]
    )
    for told, factor in ((unit, 1e-3 if unit == "ms" else 1e-6), ("s", 1.0)):
        record = read_one(path, [f"voltage=u velocity=y time=tiempo:{told} gap=1e6"])
        np.testing.assert_allclose(np.diff(record.time), step * factor)


def test_text_columns_are_ignored(tmp_path):
    rng = np.random.default_rng(8)
    pairs = zip(np.repeat(rng.uniform(-6, 6, 20), 10), np.cumsum(rng.normal(0, 1, 200)))
    rows = [
        f"{0.01 * k:.2f};'map';{u};{y};{'2.5A' if k % 7 else ''}" for k, (u, y) in enumerate(pairs)
    ]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["t;frame;u;y;remark", *rows]))
    (info,) = list_topics(path)[0].topics
    assert info.fields == ["t", "u", "y"]
    assert len(read_records(path, ["voltage=u velocity=y time=t"])["motor"]) == len(rows)
    assert_refused(
        "line 2, column 'frame': \"'map'\" is not a number",
        path,
        ["voltage=frame velocity=y time=t"],
    )


def test_quoted_decimal_commas_are_not_quoted_rows(tmp_path):
    (tmp_path / "u.csv").write_text('"u"\n' + "".join(f'"{x:g}"\n'.replace(".", ",") for x in U))
    assert list_topics(tmp_path / "u.csv")[0].topics[0].fields == ["u"]


def test_time_offset_in_mapping_aligns_two_tables(tmp_path):
    time = np.arange(100) * 0.02
    voltage, late = np.where(time % 0.6 < 0.3, 3.0, -3.0), (0.0, 0.5)
    write_table(tmp_path / "set.csv", t=time, u=voltage)
    records = []
    for shift in late:
        write_table(tmp_path / "state.csv", ts=time + shift, w=np.cumsum(voltage))
        mapping = [f"voltage=/set.u velocity=/state.w time=/state.ts-{shift}"]
        records.append(read_one(tmp_path, mapping))
    np.testing.assert_array_equal(*(record.voltage for record in records))


def test_files_of_two_motors_are_experiments_of_each_motor(tmp_path):
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(table())
    mapping = ["time=t left.voltage=u left.velocity=y:deg/s right.voltage=y right.velocity=u"]
    found = read_experiments(tmp_path, mapping)
    assert {wheel: len(records) for wheel, records in found.items()} == {"left": 2, "right": 2}


def test_column_is_found_by_name_without_unit(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(table(";", ",", "Zeit [ms],Spannung [V],Drehzahl [rpm]"))
    mapping = "voltage=Spannung velocity=Drehzahl time=Zeit"
    record = read_records(path, [mapping])["motor"]
    np.testing.assert_allclose(np.diff(record.time), 0.02e-3)
    np.testing.assert_allclose(record.velocity, Y * np.pi / 30)
    path.write_text(table(head="t,y [V],y [rpm]"))
    assert_refused("no column 'y'", path, ["voltage=y velocity=y time=t"])


@pytest.mark.parametrize(
    ("text", "mapping", "reason"),
    [
        ("", MAP, "is empty"),
        ("0.0,1.0,2.0\n0.1,1.0,2.0\n", MAP, "it has c1, c2, c3"),
        ("t,u,y\n", MAP, "no rows"),
        ("t,u,y\n0,1,2\n1,1,abc\n", MAP, "line 3, column 'y': 'abc' is not a number"),
        (table(), ["voltage=u velocity=speed time=t"], "no column 'speed'; it has t, u, y"),
        (table(), ["voltage=u velocity=y"], "the column of time is unknown"),
        (table(), None, "needs a mapping, such as"),
        ("t,u,y\n0,1,2\n", MAP, "fewer than 2"),
        (lines("2262-05-01T00:00:00.{:03},{},{}", times=range(0, 100, 20)), MAP, "to 2261"),
        (lines("0,{1},{2}"), MAP, "all 5 rows have the same time, 0 s"),
        (lines("{0},nan,{2}"), MAP, "u holds no number"),
        (lines("{0},{1},"), MAP, "y holds no number"),
        ("\x00\xff\xfe", MAP, "log.csv"),
    ],
)
def test_unreadable_files_are_refused_with_name_and_reason(tmp_path, text, mapping, reason):
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode("latin-1"))
    assert_refused(re.escape(reason), path, mapping)


@pytest.mark.skipif(not DATA.exists(), reason="recordings are not at hand")
def test_recordings_of_real_motors_are_read():
    path = DATA / "prbs_gearmotor" / "prbs_2026-08-14.csv"
    record = read_records(path, MAP)["motor"]
    assert len(record) == 4093
    assert record.sample_time == pytest.approx(0.02)
    assert record.starts == (0,)
    assert list_topics(path)[0].suggestion == ["voltage=u", "velocity=y", "time=t"]
    steps = DATA / "step_gearmotor"
    mapping = [
        "voltage=Commanded_PWM*12/5319-12/5319",
        "velocity=Motor_Speed(RPM)-1.24:rpm",
        "time=Timestamp(ms):ms",
        "velocity_window=0.032",
    ]
    records = read_experiments(steps, mapping)["motor"]
    assert len(records) == 10
    # Duty cycles of about 30 to 75 % of 12 V, in odd numbers of ticks.
    highest = sorted(np.abs(record.voltage).max() / 12 for record in records)
    assert highest[0] == pytest.approx(0.3, abs=0.03)
    assert highest[-1] == pytest.approx(0.75, abs=0.03)
    assert records[0].velocity_window == 0.032


def test_units_are_read_with_labels_of_several_words(tmp_path):
    rows = [f"PWM percent: {u}%, Motor speed: {y} rpm" for u, y in zip(U, Y)]
    (tmp_path / "log.txt").write_text("\n".join(["connected", *rows]))
    info = list_topics(tmp_path / "log.txt")[0].topics[0]
    assert info.fields == ["PWM percent [%]", "Motor speed [rpm]"]
    assert info.units == {"PWM percent [%]": "%", "Motor speed [rpm]": "rpm"}


def write_columns(folder: Path, *names: str) -> list[Path]:
    """Write one file per column."""
    held = {"t": 0.02 * np.arange(5), "u": U, "y": Y}
    for name in names:
        (folder / f"{name}.txt").write_text("\n".join([name, *map(repr, held[name].tolist())]))
    return [folder / f"{name}.txt" for name in names]


@pytest.mark.parametrize("mapping", [MAP, ["voltage=/u.u velocity=/y.y:deg/s time=/t.t"]])
def test_recording_with_one_file_per_column_is_combined(tmp_path, mapping):
    record = read_records(write_columns(tmp_path, "t", "u", "y"), mapping)["motor"]
    np.testing.assert_allclose(record.velocity, Y * np.pi / 180)
    np.testing.assert_allclose(record.time, 0.02 * np.arange(5))
    given = [
        mapping[0].replace("time=t", "sample_time=0.1").replace("time=/t.t", "sample_time=0.1")
    ]
    record = read_records(write_columns(tmp_path, "u", "y"), given)["motor"]
    np.testing.assert_allclose(record.time, 0.1 * np.arange(5))


def test_time_column_of_different_length_is_refused(tmp_path):
    files = write_columns(tmp_path, "t", "u", "y")
    files[0].write_text("t\n0\n1\n")
    assert_refused(r"has 5 rows, and their time /t\.t has 2", files, MAP)
