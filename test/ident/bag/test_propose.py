# SPDX-License-Identifier: Apache-2.0
"""Mappings are proposed from field names confirmed by the data, and can be read."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from recordings import (
    START,
    TYPES,
    Sent,
    assert_refused,
    floats,
    follow,
    in_order,
    joint_state,
    serialized,
    write_mcap,
    write_table,
)

from smp_motor_ident.bag import Listing, list_topics, read_records

N = 600
T = 0.01 * np.arange(N)


def motor(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return voltage and speed of a first-order motor with noise, 20 rad/s/V and 0.1 s."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-6, 6, N // 20), 20)
    return voltage, follow(voltage) + rng.normal(0, 0.5, N)


def write(path: Path, **columns: np.ndarray) -> Path:
    return write_table(
        path, ";", **{name: column.astype(float) for name, column in columns.items()}
    )


def test_mapping_of_two_wheels_is_proposed_and_pwm_full_scale_requested(tmp_path):
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
    assert list_requested_keys(listing) == ["pwm_full_scale", "supply_voltage"]
    given = [*listing.suggestion, "pwm_full_scale=32767", "supply_voltage=12"]
    records = read_records(tmp_path / "bag.mcap", given)
    np.testing.assert_allclose(records["right"].velocity, z)
    # Resolution: 12 V / 32767.
    np.testing.assert_allclose(records["left"].voltage[1:], u[:-1], atol=12 / 32767)


@pytest.mark.parametrize(
    ("names", "suggestion"),
    [
        (("Zeit", "Spannung", "Drehzahl"), ["voltage=Spannung", "velocity=Drehzahl:rpm"]),
        (("tiempo", "tension", "velocidad"), ["voltage=tension", "velocity=velocidad"]),
        (("时间", "电压", "速度"), ["voltage=电压", "velocity=速度"]),
        (("time [s]", "u [mV]", "speed [rpm]"),
         ['voltage="u [mV]":mV', 'velocity="speed [rpm]":rpm']),
    ],
)  # fmt: skip
def test_names_in_other_languages_and_bracketed_units_are_recognised(tmp_path, names, suggestion):
    path = write(tmp_path / "log.csv", **dict(zip(names, (T, *motor(3)))))
    assert list_topics(path)[0].suggestion[:2] == suggestion
    assert len(read_records(path, list_topics(path)[0].suggestion)["motor"]) == N


def list_requested_keys(listing: Listing) -> list[str]:
    return [text.partition("=")[0] for text in listing.asked]


def simulate_random_walks() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(26)
    return {f"signal_{chr(97 + k)}": np.cumsum(rng.normal(0, 1, 32)) for k in range(16)}


UNSIGNED = dict(t=T, u=np.abs(motor(14)[0]))
OTHER = np.convolve(motor(12)[1], [0.0, 0.5, 0.5])[:N]
NO_VOLTAGE, NO_MOTION = "no field is called a voltage", "no field is called a motion"
NONE_EXPLAINS = "no field that is called a voltage explains one that is called a motion"
PROPOSED = {
    # Seed of the motor, columns made of its voltage and speed, and the proposed mapping.
    "the voltage that explains the speed": (
        4, lambda u, w: dict(t=T, u_other=motor(5)[0], input_volts=u, omega=w),
        "voltage=input_volts velocity=omega time=t"),
    "duty as fraction": (13, lambda u, w: dict(t_ms=1e3 * T, duty=u / 6, w=w),
                         "voltage=duty:duty velocity=w time=t_ms:ms"),
    "duty up to 100": (13, lambda u, w: dict(t_ms=1e3 * T, duty=u / 6 * 100, w=w),
                       "voltage=duty:pwm velocity=w time=t_ms:ms"),
    "duty_pct in percent": (13, lambda u, w: dict(t_ms=1e3 * T, duty_pct=u / 6 * 100, w=w),
                            "voltage=duty_pct:% velocity=w time=t_ms:ms"),
    "duty_percent as fraction": (13, lambda u, w: dict(t_ms=1e3 * T, duty_percent=u / 6, w=w),
                                 "voltage=duty_percent:% velocity=w time=t_ms:ms"),
    "unsigned voltage with direction": (14, lambda u, w: UNSIGNED | dict(dir=u > 0, w=w),
                                        "voltage=u velocity=w direction=dir time=t"),
    "signed voltage without direction": (14, lambda u, w: dict(t=T, u=u, dir=u > 0, w=w),
                                         "voltage=u velocity=w time=t"),
    "unsigned voltage and speed": (
        14, lambda u, w: UNSIGNED | dict(dir=np.where(u > 0, 1, 2), w=np.abs(w)),
        "voltage=u velocity=w time=t"),
    "fractional encoder as position": (15, lambda u, w: dict(t=T, u=u, encoder=np.cumsum(w) * 0.01),
                                       "voltage=u position=encoder time=t"),
    "common voltage of two motors": (
        23, lambda u, w: dict(t=T, u=u, velL=w, velR=0.9 * w),
        "left.voltage=u left.velocity=velL right.voltage=u right.velocity=velR time=t"),
    "switched Vin": (24, lambda u, w: dict(time=T, Vin=u, taco=w),
                     "voltage=Vin velocity=taco time=time"),
    "nearest word of a dotted name": (
        25, lambda u, w: {"Vin_test.taco.time": T, "Vin_test.taco.values": w,
                          "Vin_test.Vin.values": u},
        'voltage="Vin_test.Vin.values" velocity="Vin_test.taco.values" time="Vin_test.taco.time"'),
    "volts preferred to PWM, speed to count differences": (
        11, lambda u, w: dict(t=T, pwm=np.rint(u / 12 * 999), Voltage_V=np.round(u, 3),
                              Delta_Count=np.rint(w * 20), rpm=w),
        "voltage=Voltage_V velocity=rpm:rpm time=t"),
    "accumulated counts": (
        11, lambda u, w: dict(t=T, pwm=np.rint(u / 12 * 999), Voltage_V=np.round(u, 3),
                              encoder=np.cumsum(np.rint(w * 20))),
        "voltage=Voltage_V count=encoder time=t"),
    "power preferred to speed of another wheel": (
        12, lambda u, w: dict(t=T, powerPctLeft=np.rint(u * 10), vLeft=w, vRight=OTHER),
        "voltage=powerPctLeft:% velocity=vLeft time=t"),
    "angle wrapping at 360 degrees": (
        13, lambda u, w: dict(t=T, volts=u, angle=np.rad2deg(np.cumsum(w) * 0.001) % 360),
        "voltage=volts position=angle:deg time=t"),
    "time is not a voltage": (1, lambda u, w: dict(t=T, input=1e3 * T, pwm=u, speed=w),
                              "voltage=pwm:pwm velocity=speed time=t"),
    "normalised voltage is not a speed": (
        1, lambda u, w: dict(time=T, battery=0 * u + 12, autospeed=u / 12, voltage=u, velocity=w),
        "voltage=voltage velocity=velocity time=time"),
    "speed command is not a voltage": (1, lambda u, w: dict(t=T, speed_cmd=20 * u, u=u, speed=w),
                                       "voltage=u velocity=speed time=t"),
}  # fmt: skip
NOT_PROPOSED = [
    (6, lambda u, w: dict(t=T, voltage=u, temperature=motor(7)[1]), NO_MOTION),
    (6, lambda u, w: dict(t=T, temperature=u, speed=motor(7)[1]), NO_VOLTAGE),
    (6, lambda u, w: dict(t=T, heat=u, light=motor(7)[1]), NO_VOLTAGE + " or a motion"),
    (6, lambda u, w: dict(t=T, voltage=u, speed=motor(7)[1]), NONE_EXPLAINS),
    *((12, lambda u, w, name=name: {"Tempo": T, name: 300.0 - w, "Esforço": u}, NO_MOTION)
      for name in ("Erro", "error", "Fehler", "ang_err")),
    (11, lambda u, w: dict(zip(("c1", "c2", "c3"), (T, np.cumsum(w) * 0.01, w))),
     NO_VOLTAGE + " or a motion"),
    (14, lambda u, w: UNSIGNED | dict(dir=np.where(u > 0, 1, 2), w=w),
     NONE_EXPLAINS + "; dir: direction has the values 1, 2, and which is backwards is unknown"),
    (15, lambda u, w: dict(t=T, u=u, encoder_V=np.cumsum(w) * 0.01), NO_MOTION),
    (24, lambda u, w: dict(time=T, vin=12 - 0.01 * np.abs(w), taco=w), NO_VOLTAGE),
    (26, lambda u, w: simulate_random_walks(), NO_VOLTAGE + " or a motion"),
    (1, lambda u, w: dict(t=T, input=1e3 * T, speed=w), NONE_EXPLAINS),
    (1, lambda u, w: {"t": T, "pose.x": u, "pose.y": np.cumsum(w), "speed": w,
                      "motor_current": 0.3 * u}, NO_VOLTAGE),
    (1, lambda u, w: dict(x=u, y=np.cumsum(w), theta=0.01 * np.cumsum(w), omega=w),
     NO_VOLTAGE),
    (1, lambda u, w: dict(t=T, speed_cmd=20 * u, speed=w), NO_VOLTAGE),
]  # fmt: skip


@pytest.mark.parametrize("name", PROPOSED)
def test_mapping_is_proposed_when_data_confirm_field_names(tmp_path, name):
    seed, columns, items = PROPOSED[name]
    listing = list_topics(write(tmp_path / "log.csv", **columns(*motor(seed))))[0]
    assert " ".join(listing.suggestion) == items
    if "duty" in name:
        scale = ["pwm_full_scale"] if ":pwm" in items else []
        assert list_requested_keys(listing) == [*scale, "supply_voltage"]


@pytest.mark.parametrize(("seed", "columns", "remark"), NOT_PROPOSED)
def test_no_mapping_is_proposed_when_no_voltage_explains_a_motion(tmp_path, seed, columns, remark):
    listing = list_topics(write(tmp_path / "log.csv", **columns(*motor(seed))))[0]
    assert listing.suggestion == [] and listing.remark.split(". ")[0] == remark


@pytest.mark.parametrize(
    ("begin", "end", "remark"),
    [
        pytest.param(0, N, "is constant", id="constant"),
        pytest.param(0, N - 1, "changes 1 time only", id="switched off at the last sample"),
        pytest.param(100, 500, "changes 2 times only", id="on and off"),
    ],
)
def test_mapping_of_step_response_is_proposed_by_names_alone(tmp_path, begin, end, remark):
    voltage = np.where((np.arange(N) >= begin) & (np.arange(N) < end), 12.0, 0.0)
    speed = 240 * (1 - np.exp(-np.maximum(T - T[begin], 0) / 0.1))
    speed += np.random.default_rng(8).normal(0, 5, N)
    path = write(tmp_path / "log.csv", Time_sec=T, Voltage_V=voltage, Speed_rad_s=speed)
    listing = list_topics(path)[0]
    assert listing.suggestion == ["voltage=Voltage_V", "velocity=Speed_rad_s", "time=Time_sec"]
    assert listing.remark.startswith(f"Voltage_V {remark}, so the data cannot confirm")
    assert len(read_records(path, listing.suggestion)["motor"]) == N


def test_proposed_rim_speed_requests_wheel_radius(tmp_path):
    path = write(tmp_path / "log.csv", **dict(zip(("t", "u", "speed (m/s)"), (T, *motor(9)))))
    listing = list_topics(path)[0]
    assert listing.suggestion[1] == 'velocity="speed (m/s)":m/s'
    assert list_requested_keys(listing) == ["wheel_radius"]
    assert len(read_records(path, [*listing.suggestion, "wheel_radius=0.05"])["motor"]) == N


def test_proposed_electrical_speed_requests_pole_pairs(tmp_path):
    """VESC Tool logs electrical speed."""
    voltage, speed = motor(9)
    path = write(tmp_path / "log.csv", ms_today=1e3 * T, duty_cycle=voltage / 12, erpm=speed)
    listing = list_topics(path)[0]
    assert listing.suggestion[1] == "velocity=erpm:erpm"
    assert [text.partition("=")[0] for text in listing.asked] == ["supply_voltage", "pole_pairs"]
    mapping = ["voltage=duty_cycle:duty supply_voltage=12 velocity=erpm time=ms_today:ms"]
    assert_refused("'erpm' needs pole_pairs of the motor", path, mapping)
    record = read_records(path, [*mapping, "pole_pairs=7"])["motor"]
    np.testing.assert_allclose(record.velocity, speed * np.pi / 30 / 7, rtol=1e-9)


@pytest.mark.parametrize(
    ("names", "separator", "suggestion"),
    [
        (None, " ", ["voltage=c2:pwm", "count=c3", "time=c1"]),
        (("a", "b", "d"), ";", ["voltage=b:pwm", "count=d", "time=a"]),
        (("a", "pwm", "d"), ";", ["voltage=pwm:pwm", "count=d", "time=a"]),
        (("a", "b", "encoder"), ";", ["voltage=b:pwm", "count=encoder", "time=a"]),
    ],
)
def test_mapping_is_proposed_from_data_when_names_are_unclear(
    tmp_path, names, separator, suggestion
):
    voltage, speed = motor(10)
    columns = (10 * np.arange(N), np.rint(voltage / 6 * 255), np.rint(np.cumsum(speed) / 20))
    lines = [separator.join(f"{x:.0f}" for x in row) for row in zip(*columns)]
    path = tmp_path / "log.txt"
    path.write_text("\n".join(([separator.join(names)] if names else []) + lines))
    listing = list_topics(path)[0]
    assert listing.suggestion == suggestion
    told = ["pwm_full_scale", "supply_voltage", "counts_per_revolution", "time"]
    assert list_requested_keys(listing) == told
    assert listing.remark.startswith("by the data alone")
    given = [*listing.suggestion[:2], suggestion[2] + ":ms", "pwm_full_scale=255 supply_voltage=6"]
    record = read_records(path, [*given, "counts_per_revolution=48"])["motor"]
    np.testing.assert_allclose(np.diff(record.time), 0.01)
    np.testing.assert_allclose(record.voltage[1:], voltage[:-1], atol=6 / 255)


def test_sample_time_of_table_without_time_is_requested(tmp_path):
    path = write(tmp_path / "log.csv", **dict(zip("uy", motor(12))))
    listing = list_topics(path)[0]
    assert listing.suggestion == ["voltage=u", "velocity=y"]
    assert list_requested_keys(listing) == ["velocity", "sample_time"]  # "w" would be in rad/s
    assert len(read_records(path, [*listing.suggestion, "sample_time=0.01"])["motor"]) == N


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
def test_motors_are_distinguished_by_column_names(tmp_path, names, wheels):
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


def test_columns_of_one_length_are_listed_and_proposed_together(tmp_path):
    voltage, speed = motor(27)
    content = {"id": {"InputData": voltage, "OutputData": speed, "last": np.arange(6.0)}, "t": T}
    scipy.io.savemat(tmp_path / "lab.mat", content | {"limits": np.array([-12.0, 12.0])})
    listing = list_topics(tmp_path / "lab.mat")[0]
    assert [(info.count, info.fields) for info in listing.topics] == [
        (N, ["id.InputData", "id.OutputData", "t"]),
        (6, ["id.last"]),
        (2, ["limits"]),
    ]
    items = ['voltage="id.InputData"', 'velocity="id.OutputData"', "time=t"]
    assert listing.suggestion == items
    assert len(read_records(tmp_path / "lab.mat", items)["motor"]) == N
    assert_refused(
        r"differ in length: limits 2, .*map columns of one length",
        tmp_path / "lab.mat",
        ["voltage=limits", *items[1:]],
    )


def make_robot_messages(
    space: str, efforts: np.ndarray, seed: int, drive: str = "pwm"
) -> list[object]:
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
    """Return an effort of zeros, of NaN, or proportional to the current."""
    voltage, speed = motor(seed)
    current = 0.3 * (voltage - speed / 20)
    return {"zeros": np.zeros(N), "nan": np.full(N, np.nan), "current": current}[kind]


@pytest.mark.parametrize("kind", ["zeros", "nan", "current"])
@pytest.mark.parametrize("drive", ["pwm", "wheel_command"])
def test_joint_effort_is_not_proposed_when_a_command_exists(tmp_path, kind, drive):
    sent = make_robot_messages("", efforts(kind), 1, drive)
    listing = list_topics(write_mcap(tmp_path / "bag.mcap", sent))[0]
    assert listing.suggestion == [
        f"left.voltage=/{drive}.data:pwm",
        "left.velocity=/joint_states.velocity[left_wheel]",
    ]
    assert list_requested_keys(listing) == ["pwm_full_scale", "supply_voltage"]


def test_joint_effort_is_not_proposed_when_command_rate_is_low(tmp_path):
    sent = make_robot_messages("", efforts("current"), 1, "duty")
    seldom = [s for s in sent if "duty" not in s.topic or s.stamp // 10**7 % 3 == 0]
    listing = list_topics(write_mcap(tmp_path / "bag.mcap", seldom))[0]
    assert listing.suggestion[0] == "left.voltage=/duty.data:pwm"


def test_joint_effort_is_proposed_with_a_note_when_no_command_exists(tmp_path):
    sent = [s for s in make_robot_messages("", motor(1)[0], 1) if "pwm" not in s.topic]
    listing = list_topics(write_mcap(tmp_path / "bag.mcap", sent))[0]
    assert listing.suggestion[0] == "left.voltage=/joint_states.effort[left_wheel]"
    assert "is a torque [N m] by its message's documentation" in listing.remark


def test_mapping_of_every_robot_in_bag_is_proposed(tmp_path):
    both = [m for k in (1, 2) for m in make_robot_messages(f"/robot{k}", np.zeros(N), k)]
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


@pytest.mark.parametrize("column", ["position", "voltage"])
def test_column_without_numbers_is_reported(tmp_path, column):
    columns = {"t": T, "voltage": motor(1)[0], "position": np.cumsum(motor(1)[1])}
    path = write(tmp_path / "log.csv", **{**columns, column: np.full(N, np.nan)})
    listing = list_topics(path)[0]
    assert listing.topics[0].fields == ["t", "voltage", "position"]
    assert f"{column} holds no number" in listing.remark


@pytest.mark.parametrize(
    "name", ["speed (rad/s)", "speed-2", 'a "fast" speed', "speed b=c", "v: speed", "/a.speed*2"]
)
def test_proposed_column_name_is_accepted_in_mapping(tmp_path, name):
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
