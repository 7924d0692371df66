# SPDX-License-Identifier: Apache-2.0
"""Proposed mappings have signals that behave according to their names, and can be read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from recordings import (
    START,
    TYPES,
    Sent,
    floats,
    in_order,
    joint_state,
    serialized,
    write_mcap,
)

from smp_motor_ident.bag import Listing, list_topics, read_records
from smp_motor_ident.errors import BagError

N = 600
T = 0.01 * np.arange(N)


def motor(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return voltage and speed of a first-order motor with noise, 20 rad/s/V and 0.1 s."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-6, 6, N // 20), 20)
    speed = np.zeros(N)
    for k in range(1, N):
        speed[k] = speed[k - 1] + (1 - np.exp(-0.1)) * (20 * voltage[k - 1] - speed[k - 1])
    return voltage, speed + rng.normal(0, 0.5, N)


def write(path: Path, **columns: Sequence[float]) -> Path:
    rows = zip(*columns.values())
    lines = [";".join(columns), *(";".join(repr(float(v)) for v in row) for row in rows)]
    path.write_text("\n".join(lines))
    return path


def test_a_bag_of_two_wheels_is_mapped_and_the_pwms_full_scale_asked_for(tmp_path):
    (u, y), (v, z) = motor(1), motor(2)
    twist, vector = "geometry_msgs/msg/Twist", TYPES.types["geometry_msgs/msg/Vector3"]
    at = START + np.rint(1e9 * T).astype(np.int64)
    ticks = (
        floats(t, at, np.rint(x / 12 * 32767)) for t, x in (("/left/pwm", u), ("/right/pwm", v))
    )
    sent = in_order(
        *ticks,
        [joint_state(t, ["left_wheel", "right_wheel"], both) for t, *both in zip(at, y, z)],
        [
            Sent("/cmd_vel", twist, int(t), serialized(twist, linear=vector(x, 0.0, 0.0),
                                                       angular=vector(0.0, 0.0, 0.0)))
            for t, x in zip(at, u.tolist())
        ],
    )  # fmt: skip
    listing = list_topics(write_mcap(tmp_path / "bag.mcap", sent))[0]
    assert listing.suggestion == [
        "left.voltage=/left/pwm.data:pwm",
        "left.velocity=/joint_states.velocity[left_wheel]",
        "right.voltage=/right/pwm.data:pwm",
        "right.velocity=/joint_states.velocity[right_wheel]",
    ]
    assert [text.partition("=")[0] for text in listing.asked] == [
        "pwm_full_scale",
        "supply_voltage",
    ]
    given = [*listing.suggestion, "pwm_full_scale=32767", "supply_voltage=12"]
    records = read_records(tmp_path / "bag.mcap", given)
    np.testing.assert_allclose(records["right"].velocity, z)
    # One step of 32767 ticks of 12 V.
    np.testing.assert_allclose(records["left"].voltage[1:], u[:-1], atol=12 / 32767)


@pytest.mark.parametrize(
    ("names", "suggestion"),
    [
        (("Zeit", "Spannung", "Drehzahl"), ["voltage=Spannung", "velocity=Drehzahl:rpm"]),
        (("tiempo", "tension", "velocidad"), ["voltage=tension", "velocity=velocidad"]),
        (("时间", "电压", "速度"), ["voltage=电压", "velocity=速度"]),
        (
            ("time [s]", "u [mV]", "speed [rpm]"),
            ['voltage="u [mV]":mV', 'velocity="speed [rpm]":rpm'],
        ),
    ],
)
def test_names_of_other_languages_and_units_in_brackets_are_understood(tmp_path, names, suggestion):
    path = write(tmp_path / "log.csv", **dict(zip(names, (T, *motor(3)))))
    assert list_topics(path)[0].suggestion[:2] == suggestion
    assert len(read_records(path, list_topics(path)[0].suggestion)["motor"]) == N


def test_of_two_voltages_the_one_that_explains_the_speed_is_proposed(tmp_path):
    voltage, speed = motor(4)
    other = motor(5)[0]
    path = write(tmp_path / "log.csv", t=T, u_other=other, input_volts=voltage, omega=speed)
    assert list_topics(path)[0].suggestion[0] == "voltage=input_volts"


def test_nothing_is_proposed_where_nothing_explains_the_speed(tmp_path):
    path = write(tmp_path / "log.csv", t=T, voltage=motor(6)[0], speed=motor(7)[1])
    assert list_topics(path)[0].suggestion == []


@pytest.mark.parametrize(
    ("begin", "end", "remark"),
    [
        pytest.param(0, N, "is constant", id="constant"),
        pytest.param(0, N - 1, "changes 1 time only", id="switched off at the last sample"),
        pytest.param(100, 500, "changes 2 times only", id="on and off"),
    ],
)
def test_a_step_that_no_test_can_confirm_is_proposed_by_names(tmp_path, begin, end, remark):
    voltage = np.where((np.arange(N) >= begin) & (np.arange(N) < end), 12.0, 0.0)
    speed = 240 * (1 - np.exp(-np.maximum(T - T[begin], 0) / 0.1))
    speed += np.random.default_rng(8).normal(0, 5, N)
    path = write(tmp_path / "log.csv", Time_sec=T, Voltage_V=voltage, Speed_rad_s=speed)
    listing = list_topics(path)[0]
    assert listing.suggestion == ["voltage=Voltage_V", "velocity=Speed_rad_s", "time=Time_sec"]
    assert listing.remark.startswith(f"Voltage_V {remark}, so the data cannot confirm")
    assert len(read_records(path, listing.suggestion)["motor"]) == N


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (("t", "voltage", "temperature"), "no field is called a motion"),
        (("t", "temperature", "speed"), "no field is called a voltage"),
        (("t", "heat", "light"), "no field is called a voltage or a motion"),
        (("t", "voltage", "speed"), "no field that is called a voltage explains one that"),
    ],
)
def test_why_nothing_is_proposed_is_told(tmp_path, names, reason):
    path = write(tmp_path / "log.csv", **dict(zip(names, (T, motor(6)[0], motor(7)[1]))))
    listing = list_topics(path)[0]
    assert listing.suggestion == []
    assert listing.remark.startswith(reason)


def test_a_mapping_of_the_rim_asks_for_the_wheels_radius(tmp_path):
    path = write(tmp_path / "log.csv", **dict(zip(("t", "u", "speed (m/s)"), (T, *motor(9)))))
    listing = list_topics(path)[0]
    assert listing.suggestion[1] == 'velocity="speed (m/s)":m/s'
    assert [text.partition("=")[0] for text in listing.asked] == ["wheel_radius"]
    assert len(read_records(path, [*listing.suggestion, "wheel_radius=0.05"])["motor"]) == N


def asked(listing: Listing) -> list[str]:
    return [text.partition("=")[0] for text in listing.asked]


@pytest.mark.parametrize(
    ("names", "separator", "suggestion"),
    [
        (None, " ", ["voltage=c2:pwm", "count=c3", "time=c1"]),
        (("a", "b", "d"), ";", ["voltage=b:pwm", "count=d", "time=a"]),
        (("a", "pwm", "d"), ";", ["voltage=pwm:pwm", "count=d", "time=a"]),
        (("a", "b", "encoder"), ";", ["voltage=b:pwm", "count=encoder", "time=a"]),
    ],
)
def test_where_names_tell_too_little_the_data_do(tmp_path, names, separator, suggestion):
    voltage, speed = motor(10)
    columns = (10 * np.arange(N), np.rint(voltage / 6 * 255), np.rint(np.cumsum(speed) / 20))
    lines = [separator.join(f"{x:.0f}" for x in row) for row in zip(*columns)]
    path = tmp_path / "log.txt"
    path.write_text("\n".join(([separator.join(names)] if names else []) + lines))
    listing = list_topics(path)[0]
    assert listing.suggestion == suggestion
    told = ["pwm_full_scale", "supply_voltage", "counts_per_revolution", "time"]
    assert asked(listing) == told
    assert listing.remark.startswith("by the data alone")
    given = [*listing.suggestion[:2], suggestion[2] + ":ms", "pwm_full_scale=255 supply_voltage=6"]
    record = read_records(path, [*given, "counts_per_revolution=48"])["motor"]
    np.testing.assert_allclose(np.diff(record.time), 0.01)
    np.testing.assert_allclose(record.voltage[1:], voltage[:-1], atol=6 / 255)


@pytest.mark.parametrize("error", ["Erro", "error", "Fehler", "ang_err"])
def test_the_error_of_a_loop_is_not_a_motion(tmp_path, error):
    voltage, speed = motor(12)
    rows = zip(T, 300.0 - speed, voltage)
    text = "\n".join(f"{t:.2f};{e:.4f};{v:.4f}" for t, e, v in rows)
    (tmp_path / "log.csv").write_text(f"Tempo;{error};Esforço\n{text}")
    listing = list_topics(tmp_path / "log.csv")[0]
    assert listing.suggestion == [] and listing.remark == "no field is called a motion"


def test_a_speed_is_not_proposed_as_the_voltage_of_its_own_angle(tmp_path):
    speed = motor(11)[1]
    rows = zip(T, np.cumsum(speed) * 0.01, speed)
    (tmp_path / "log.txt").write_text("\n".join(f"{t:.2f} {a:.4f} {w:.4f}" for t, a, w in rows))
    listing = list_topics(tmp_path / "log.txt")[0]
    assert listing.suggestion == []
    assert listing.remark == "no field is called a voltage or a motion"


def test_the_interval_of_a_table_without_time_is_asked_for(tmp_path):
    path = write(tmp_path / "log.csv", **dict(zip("uy", motor(12))))
    listing = list_topics(path)[0]
    assert listing.suggestion == ["voltage=u", "velocity=y"]
    assert asked(listing) == ["velocity", "sample_time"]  # "w" would be in rad/s
    assert len(read_records(path, [*listing.suggestion, "sample_time=0.01"])["motor"]) == N


@pytest.mark.parametrize(
    ("name", "full", "unit", "told"),
    [
        ("duty", 1.0, ":duty", ["supply_voltage"]),
        ("duty", 100.0, ":pwm", ["pwm_full_scale", "supply_voltage"]),
        ("duty_pct", 100.0, ":%", ["supply_voltage"]),
        ("duty_percent", 1.0, ":%", ["supply_voltage"]),
    ],
)
def test_the_scale_of_a_duty_is_named_or_asked_for(tmp_path, name, full, unit, told):
    voltage, speed = motor(13)
    path = write(tmp_path / "log.csv", **{"t_ms": 1e3 * T, name: voltage / 6 * full, "w": speed})
    listing = list_topics(path)[0]
    assert listing.suggestion == [f"voltage={name}{unit}", "velocity=w", "time=t_ms:ms"]
    assert asked(listing) == told


def test_a_size_is_proposed_with_its_direction(tmp_path):
    voltage, speed = motor(14)
    columns = {"t": T, "u": np.abs(voltage), "dir": voltage > 0, "w": speed}
    listing = list_topics(write(tmp_path / "log.csv", **columns))[0]
    assert listing.suggestion == ["voltage=u", "velocity=w", "direction=dir", "time=t"]
    listing = list_topics(write(tmp_path / "log.csv", **{**columns, "u": voltage}))[0]
    assert listing.suggestion == ["voltage=u", "velocity=w", "time=t"]  # it has its sign
    columns["dir"] = np.where(voltage > 0, 1, 2)
    listing = list_topics(write(tmp_path / "log.csv", **columns))[0]
    assert listing.suggestion == []
    assert "which is backwards is unknown" in listing.remark
    columns["w"] = np.abs(speed)
    listing = list_topics(write(tmp_path / "log.csv", **columns))[0]
    assert listing.suggestion == ["voltage=u", "velocity=w", "time=t"]


def test_fractional_numbers_are_not_counts(tmp_path):
    voltage, speed = motor(15)
    path = write(tmp_path / "log.csv", t=T, u=voltage, encoder=np.cumsum(speed) * 0.01)
    assert list_topics(path)[0].suggestion == ["voltage=u", "position=encoder", "time=t"]
    path = write(tmp_path / "log.csv", t=T, u=voltage, encoder_V=np.cumsum(speed) * 0.01)
    assert list_topics(path)[0].suggestion == []


@pytest.mark.parametrize(
    ("names", "wheels"),
    [
        (("t", "pwmL", "pwmR", "velL", "velR"), ("left", "right")),
        (("tiempo", "PWMA", "PWMB", "wA", "wB"), ("motor_a", "motor_b")),
        (("t", "u1", "u2", "rpm_1", "rpm_2"), ("motor_1", "motor_2")),
        (("t", "run_1.u", "run_2.u", "run_1.y", "run_2.y"), ("run_1", "run_2")),
        (("t", "dutyIzquierda", "dutyDerecha", "velIzquierda", "velDerecha"), None),
    ],
)
def test_motors_are_told_apart_by_the_endings_of_names(tmp_path, names, wheels):
    (u, y), (v, z) = motor(21), motor(22)
    path = write(tmp_path / "log.csv", **dict(zip(names, (T, u, v, y, z))))
    a, b = wheels or ("izquierda", "derecha")
    items = [item.partition(":")[0].replace('"', "") for item in list_topics(path)[0].suggestion]
    pairs = ((a, names[1], names[3]), (b, names[2], names[4]))
    expected = [
        item
        for wheel, drive, motion in pairs
        for item in (f"{wheel}.voltage={drive}", f"{wheel}.velocity={motion}")
    ]
    assert sorted(items) == sorted([*expected, f"time={names[0]}"])


def test_one_voltage_is_of_all_motors_that_stand_side_by_side(tmp_path):
    u, y = motor(23)
    path = write(tmp_path / "log.csv", t=T, u=u, velL=y, velR=0.9 * y)
    found = ["left.voltage=u", "left.velocity=velL", "right.voltage=u", "right.velocity=velR"]
    assert list_topics(path)[0].suggestion == [*found, "time=t"]


def test_a_vin_that_is_switched_drives_and_one_that_stays_supplies(tmp_path):
    voltage, speed = motor(24)
    path = write(tmp_path / "lab.csv", time=T, Vin=voltage, taco=speed)
    assert list_topics(path)[0].suggestion == ["voltage=Vin", "velocity=taco", "time=time"]
    sagging = 12 - 0.01 * np.abs(speed)
    path = write(tmp_path / "ina.csv", time=T, vin=sagging, taco=speed)
    assert list_topics(path)[0].remark == "no field is called a voltage"


def test_the_nearest_word_determines_the_role_of_a_field(tmp_path):
    voltage, speed = motor(25)
    names = ("Vin_test.taco.time", "Vin_test.taco.values", "Vin_test.Vin.values")
    path = write(tmp_path / "log.csv", **dict(zip(names, (T, speed, voltage))))
    quoted = [f'"{name}"' for name in names]
    items = [f"voltage={quoted[2]}", f"velocity={quoted[1]}", f"time={quoted[0]}"]
    assert list_topics(path)[0].suggestion == items


def test_a_chance_correlation_is_not_proposed(tmp_path):
    rng = np.random.default_rng(26)
    columns = {f"signal_{chr(97 + k)}": np.cumsum(rng.normal(0, 1, 32)) for k in range(16)}
    listing = list_topics(write(tmp_path / "log.csv", **columns))[0]
    assert listing.suggestion == []


def test_columns_of_one_length_are_listed_and_proposed_together(tmp_path):
    voltage, speed = motor(27)
    content = {"id": {"InputData": voltage, "OutputData": speed, "last": np.arange(6.0)}, "t": T}
    scipy.io.savemat(tmp_path / "lab.mat", content | {"limits": np.array([-12.0, 12.0])})
    listing = list_topics(tmp_path / "lab.mat")[0]
    assert [(offer.count, offer.fields) for offer in listing.offers] == [
        (N, ["id.InputData", "id.OutputData", "t"]),
        (6, ["id.last"]),
        (2, ["limits"]),
    ]
    items = ['voltage="id.InputData"', 'velocity="id.OutputData"', "time=t"]
    assert listing.suggestion == items
    assert len(read_records(tmp_path / "lab.mat", items)["motor"]) == N
    with pytest.raises(BagError, match=r"differ in length: limits 2, .*map columns of one length"):
        read_records(tmp_path / "lab.mat", ["voltage=limits", *items[1:]])


def test_counts_of_an_interval_are_no_angle_and_volts_go_before_their_pwm(tmp_path):
    voltage, speed = motor(11)
    columns = {"t": T, "pwm": np.rint(voltage / 12 * 999), "Voltage_V": np.round(voltage, 3)}
    counts = np.rint(speed * 20)
    path = write(tmp_path / "log.csv", **columns, Delta_Count=counts, rpm=speed)
    suggestion = list_topics(path)[0].suggestion
    assert suggestion == ["voltage=Voltage_V", "velocity=rpm:rpm", "time=t"]
    path = write(tmp_path / "sum.csv", **columns, encoder=np.cumsum(counts))
    assert list_topics(path)[0].suggestion == ["voltage=Voltage_V", "count=encoder", "time=t"]


def test_a_power_of_a_motor_goes_before_another_wheels_speed(tmp_path):
    voltage, speed = motor(12)
    other = np.convolve(speed, [0.0, 0.5, 0.5])[:N]
    columns = {"t": T, "powerPctLeft": np.rint(voltage * 10), "vLeft": speed, "vRight": other}
    listing = list_topics(write(tmp_path / "log.csv", **columns))[0]
    assert listing.suggestion[0] == "voltage=powerPctLeft:%"
    assert listing.suggestion[1].startswith("velocity=v")


def test_an_angle_that_starts_again_at_360_is_in_degrees(tmp_path):
    voltage, speed = motor(13)
    angle = np.rad2deg(np.cumsum(speed) * 0.001) % 360
    listing = list_topics(write(tmp_path / "log.csv", t=T, volts=voltage, angle=angle))[0]
    assert listing.suggestion[1] == "position=angle:deg"


def robot(space: str, efforts: np.ndarray, seed: int, drive: str = "pwm") -> list[object]:
    """Return the messages of one wheel: joint states with an effort, and its command."""
    voltage, speed = motor(seed)
    at = START + np.rint(1e9 * T).astype(np.int64)
    topic = f"{space}/joint_states"
    states = [
        joint_state(t, ["left_wheel"], speed[k : k + 1], effort=efforts[k : k + 1], topic=topic)
        for k, t in enumerate(at)
    ]
    return in_order(floats(f"{space}/{drive}", at, np.rint(voltage / 12 * 255)), states)


def efforts(kind: str, seed: int = 1) -> np.ndarray:
    """Return an effort of zeros, of none, or one that moves as a current does."""
    voltage, speed = motor(seed)
    current = 0.3 * (voltage - speed / 20)
    return {"zeros": np.zeros(N), "nan": np.full(N, np.nan), "current": current}[kind]


@pytest.mark.parametrize("kind", ["zeros", "nan", "current"])
@pytest.mark.parametrize("drive", ["pwm", "wheel_command"])
def test_an_effort_is_not_proposed_in_place_of_the_drive(tmp_path, kind, drive):
    sent = robot("", efforts(kind), 1, drive)
    listing = list_topics(write_mcap(tmp_path / "bag.mcap", sent))[0]
    assert listing.suggestion == [
        f"left.voltage=/{drive}.data:pwm",
        "left.velocity=/joint_states.velocity[left_wheel]",
    ]
    assert asked(listing) == ["pwm_full_scale", "supply_voltage"]


def test_an_effort_that_alone_explains_the_motion_is_proposed_with_a_note(tmp_path):
    sent = [s for s in robot("", motor(1)[0], 1) if "pwm" not in s.topic]
    listing = list_topics(write_mcap(tmp_path / "bag.mcap", sent))[0]
    assert listing.suggestion[0] == "left.voltage=/joint_states.effort[left_wheel]"
    assert "is a torque [N m] by its message's documentation" in listing.remark


def test_every_robot_of_a_bag_is_proposed(tmp_path):
    both = [m for k in (1, 2) for m in robot(f"/robot{k}", np.zeros(N), k)]
    path = write_mcap(tmp_path / "bag.mcap", sorted(both, key=lambda m: m.stamp))
    listing = list_topics(path)[0]
    assert listing.suggestion == [
        f"robot{k}_left.{what}"
        for k in (1, 2)
        for what in (
            f"voltage=/robot{k}/pwm.data:pwm",
            f"velocity=/robot{k}/joint_states.velocity[left_wheel]",
        )
    ]
    given = [*listing.suggestion, "pwm_full_scale=255", "supply_voltage=12"]
    records = read_records(path, given)
    np.testing.assert_allclose(records["robot2_left"].velocity, motor(2)[1])


def test_a_time_is_not_proposed_as_a_voltage(tmp_path):
    voltage, speed = motor(1)
    path = write(tmp_path / "log.csv", t=T, input=1e3 * T, pwm=voltage, speed=speed)
    assert list_topics(path)[0].suggestion[:2] == ["voltage=pwm:pwm", "velocity=speed"]
    path = write(tmp_path / "none.csv", t=T, input=1e3 * T, speed=speed)
    assert list_topics(path)[0].suggestion == []


def test_a_place_is_not_proposed_where_a_speed_is_named(tmp_path):
    voltage, speed = motor(1)
    columns = {"pose.x": voltage, "pose.y": np.cumsum(speed), "speed": speed}
    path = write(tmp_path / "log.csv", t=T, **columns, motor_current=0.3 * voltage)
    listing = list_topics(path)[0]
    assert listing.suggestion == [] and listing.remark == "no field is called a voltage"


def test_columns_of_a_pose_are_not_a_drive(tmp_path):
    voltage, speed = motor(1)
    theta = 0.01 * np.cumsum(speed)
    path = write(tmp_path / "log.csv", x=voltage, y=np.cumsum(speed), theta=theta, omega=speed)
    listing = list_topics(path)[0]
    assert listing.suggestion == []


def test_a_speed_command_is_not_proposed_as_a_voltage(tmp_path):
    voltage, speed = motor(1)
    path = write(tmp_path / "log.csv", t=T, speed_cmd=20 * voltage, u=voltage, speed=speed)
    assert list_topics(path)[0].suggestion[0] == "voltage=u"
    path = write(tmp_path / "none.csv", t=T, speed_cmd=20 * voltage, speed=speed)
    assert list_topics(path)[0].suggestion == []


@pytest.mark.parametrize("column", ["position", "voltage"])
def test_a_column_without_a_number_is_named(tmp_path, column):
    columns = {"t": T, "voltage": motor(1)[0], "position": np.cumsum(motor(1)[1])}
    path = write(tmp_path / "log.csv", **{**columns, column: np.full(N, np.nan)})
    listing = list_topics(path)[0]
    assert listing.offers[0].fields == ["t", "voltage", "position"]
    assert f"{column} holds no number" in listing.remark


@pytest.mark.parametrize(
    "name", ["speed (rad/s)", "speed-2", 'a "fast" speed', "speed b=c", "v: speed", "/a.speed*2"]
)
def test_a_name_that_is_printed_is_accepted_back(tmp_path, name):
    voltage, speed = motor(1)
    path = tmp_path / "my log.csv"
    quoted = '"' + name.replace('"', '""') + '"'
    rows = [f"{t!r},{u!r},{y!r}" for t, u, y in zip(T.tolist(), voltage.tolist(), speed.tolist())]
    path.write_text("\n".join([f"t,volt,{quoted}", *rows]))
    listing = list_topics(path)[0]
    assert listing.suggestion[1].startswith("velocity=")
    record = read_records(path, [" ".join(listing.suggestion)])["motor"]
    np.testing.assert_allclose(record.velocity, speed)
    other = write(tmp_path / "u.csv", t=T, volt=voltage)
    whole = '"/my log.' + name.replace('"', '""') + '"'
    items = [f"voltage=/u.volt velocity={whole} time=t"]
    record = read_records([other, path], items)["motor"]
    np.testing.assert_allclose(record.velocity, speed)
