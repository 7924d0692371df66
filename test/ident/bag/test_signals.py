# SPDX-License-Identifier: Apache-2.0
"""Any numeric field of any message is read as a signal in SI units at the motor shaft."""

import math
import re
from typing import Any

import numpy as np
import pytest
from recordings import (
    COUNTS,
    RATIO,
    START,
    STATE,
    TYPES,
    Sent,
    assert_refused,
    floats,
    header,
    in_order,
    joint_state,
    motion,
    notes,
    read,
    read_one,
    serialized,
    write_file,
    write_mcap,
    write_sqlite,
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from smp_motor_ident.bag import list_topics, read_records
from smp_motor_ident.errors import BagError

STEP = 10_000_000


def every_10_ms(topic: str, values: Any) -> list[Sent]:
    return floats(topic, START + STEP * np.arange(len(values)), values)


def joint_states(names: Any, velocities: Any, frames: Any = None) -> list[Sent]:
    """Return messages with the joints ``names(k)`` and their speeds ``velocities[k]``."""
    times = [START + k * STEP for k in range(len(velocities))]
    return [
        joint_state(at, names(k), velocities[k], header=header(at, frames(k) if frames else ""))
        for k, at in enumerate(times)
    ]


MAP = ["voltage=/pwm.data*12/255", "velocity=/joint_states.velocity[left_wheel_joint]"]


@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_pwm_counts_and_named_joint_are_read(tmp_path, storage):
    n = 100
    rng = np.random.default_rng(0)
    pwm = rng.integers(-255, 256, n)
    speed = rng.normal(0, 1, (n, 2))
    messages = in_order(
        every_10_ms("/pwm", pwm),
        joint_states(lambda _: ["right_wheel_joint", "left_wheel_joint"], speed),
    )
    record = read_one(write_file(tmp_path / f"bag.{storage}", messages), MAP)
    np.testing.assert_array_equal(record.velocity, speed[:, 1])
    # Both have the same stamps, and a command holds from its stamp on.
    np.testing.assert_allclose(record.voltage[1:], pwm[:-1] * 12 / 255, rtol=1e-15)


def test_joint_is_found_when_names_are_reordered_or_missing(tmp_path):
    n = 90
    rng = np.random.default_rng(1)
    pwm = rng.integers(-255, 256, n)
    left = rng.normal(0, 1, n)
    orders = [
        ["left_wheel_joint", "tight_wheel_joint"],
        ["tight_wheel_joint", "left_wheel_joint"],
        ["tight_wheel_joint"],
    ]
    rows = [
        [left[k], 9.0] if k % 3 == 0 else [9.0, left[k]] if k % 3 == 1 else [9.0] for k in range(n)
    ]
    frames = ["", "a", "long frame"]
    messages = in_order(
        every_10_ms("/pwm", pwm),
        joint_states(lambda k: orders[k % 3], rows, lambda k: frames[k % 2]),
    )
    record = read(tmp_path / "bag.mcap", messages, MAP)
    np.testing.assert_array_equal(record.velocity, left[np.arange(n) % 3 < 2])


def test_topic_with_varying_message_layout_is_read(tmp_path):
    n = 150
    values = np.random.default_rng(2).normal(size=n)
    messages = in_order(
        every_10_ms("/pwm", values),
        joint_states(
            lambda k: [
                *(f"joint{j}" for j in range(k % 7)),
                f"n{k}" + "x" * (k % 23),
                "left_wheel_joint",
            ],
            [[0.0] * (k % 7 + 1) + [values[k]] for k in range(n)],
        ),
    )
    record = read(tmp_path / "bag.mcap", messages, MAP)
    np.testing.assert_array_equal(record.velocity, values)


@pytest.mark.parametrize("little", [True, False])
def test_both_byte_orders_are_read(tmp_path, little):
    truth = motion()
    messages = [
        Sent("/front_left/motor_state", STATE, int(t), truth.state(k, little))
        for k, t in enumerate(truth.time)
    ]
    record = read(tmp_path / "bag.mcap", messages)
    np.testing.assert_array_equal(record.voltage, truth.voltage)
    np.testing.assert_array_equal(record.count, truth.count)


NESTED = """\
std_msgs/Header header
string label
Wheel[] wheels
bool[3] flags
int16[] raw
"""
WHEEL = "string name\nuint8 id\nfloat32 speed\nint32 ticks\n"


def nested_store() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(WHEEL, "robot_msgs/msg/Wheel"))
    store.register(get_types_from_msg(NESTED, "robot_msgs/msg/Report"))
    return store


def reports(n: int) -> tuple[list[Any], np.ndarray]:
    store = nested_store()
    values = np.random.default_rng(3).integers(-1000, 1000, (n, 2))
    sent = []
    for k in range(n):
        wheels = [
            store.types["robot_msgs/msg/Wheel"](name, 1, float(values[k, j]), int(values[k, j]))
            for j, name in enumerate(("left", "right"))
        ]
        time = START + k * STEP
        stamp = store.types["builtin_interfaces/msg/Time"](*divmod(time, 10**9))
        message = store.types["robot_msgs/msg/Report"](
            store.types["std_msgs/msg/Header"](stamp, "base"),
            "x" * (k % 5),
            wheels,
            np.array([True, False, True]),
            np.array([7, int(values[k, 0])], np.int16),
        )
        data = bytes(store.serialize_cdr(message, "robot_msgs/msg/Report"))
        sent.append(Sent("/report", "robot_msgs/msg/Report", time, data))
    return sent, values


REPORT_MAP = [
    "voltage=/report.raw[1]:mV held=before",
    "velocity=/report.wheels[right].speed:rpm",
    "count=/report.wheels[1].ticks encoder_bits=0",
]


def test_types_given_as_msg_files_are_used(tmp_path):
    sent, values = reports(60)
    path = write_sqlite(tmp_path / "bag.db3", sent, schema=3)
    assert_refused(r"robot_msgs/msg/Report.*unknown.*\.msg files", path, REPORT_MAP)
    folder = tmp_path / "robot_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Report.msg").write_text(NESTED)
    (folder / "Wheel.msg").write_text(WHEEL)
    mapping = tmp_path / "map.yaml"
    mapping.write_text(
        "types: [robot_msgs]\n"
        "held: before\n"
        "motors:\n"
        "  right:\n"
        "    voltage: {topic: /report, field: 'raw[1]', unit: mV}\n"
        "    velocity: /report.wheels[right].speed:rpm\n"
        "    count: /report.wheels[1].ticks\n"
        "    encoder_bits: 0\n"
    )
    record = read_records(path, mapping)["right"]
    np.testing.assert_allclose(record.voltage, values[:, 0] * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(record.velocity, values[:, 1] * math.pi / 30, rtol=1e-15)
    np.testing.assert_array_equal(record.count, values[:, 1])


def test_types_defined_in_the_bag_are_used(tmp_path):
    sent, values = reports(60)
    text = nested_store().generate_msgdef("robot_msgs/msg/Report", ros_version=2)[0]
    path = write_mcap(tmp_path / "bag.mcap", sent, define=lambda _: text)
    record = read_one(path, REPORT_MAP)
    np.testing.assert_array_equal(record.count, values[:, 1])
    fields = list_topics(path)[0].topics[0].fields
    assert {"wheels[0].speed", "wheels[1].ticks", "flags[2]", "raw[1]"} <= set(fields)


@pytest.mark.parametrize(
    ("signal", "factor"),
    [
        ("rpm.data", np.pi / 30), ("rpm.data:rad/s", 1.0), ("rpm.data*2", 2.0),
        ("vel_turns_s.data", 2 * np.pi), ("VelocityRotationsPerSec.data", 2 * np.pi),
        ("VelocityRadPerSec.data", 1.0),
    ],
)  # fmt: skip
def test_unit_is_inferred_from_end_of_topic_name(tmp_path, signal, factor):
    values = np.sin(np.arange(50.0))
    topic = "/" + signal.partition(".")[0]
    sent = in_order(every_10_ms("/u", values), every_10_ms(topic, values))
    path, mapping = write_mcap(tmp_path / "bag.mcap", sent), f"voltage=/u.data velocity=/{signal}"
    record = read_records(path, [mapping])["motor"]
    np.testing.assert_allclose(record.velocity, factor * values, rtol=1e-12)


def test_body_speed_is_divided_by_wheel_radius(tmp_path):
    """``geometry_msgs/Twist`` and ``Pose`` are in m/s and m (REP 103)."""
    twist, vector = "geometry_msgs/msg/Twist", TYPES.types["geometry_msgs/msg/Vector3"]
    values = np.sin(np.arange(50.0))
    bodies = (serialized(twist, linear=vector(v, 0, 0), angular=vector(0, 0, 0)) for v in values)
    moved = [Sent("/odom", twist, START + 10**7 * k, body) for k, body in enumerate(bodies)]
    path = write_mcap(tmp_path / "bag.mcap", in_order(every_10_ms("/u", values), moved))
    mapping = ["voltage=/u.data velocity=/odom.linear.x"]
    assert_refused("'m/s' needs wheel_radius", path, mapping)
    record = read_records(path, [*mapping, "wheel_radius=0.05"])["motor"]
    np.testing.assert_allclose(record.velocity, values / 0.05, rtol=1e-12)


def test_duty_cycle_is_multiplied_by_measured_supply_voltage(tmp_path):
    n = 50
    duty = np.linspace(-1, 1, n)
    supply = np.linspace(12.6, 11.4, n)
    messages = in_order(
        every_10_ms("/duty", duty),
        every_10_ms("/battery", supply),
        every_10_ms("/speed", np.zeros(n)),
    )
    path = write_mcap(tmp_path / "bag.mcap", messages)
    mapping = ["voltage=/duty.data:duty supply=/battery.data velocity=/speed.data"]
    record = read_records(path, mapping)["motor"]
    np.testing.assert_allclose(record.voltage[1:], (duty * supply)[:-1], rtol=1e-12)
    fixed = read_records(path, ["voltage=/duty.data:duty supply_voltage=12 velocity=/speed.data"])
    np.testing.assert_allclose(fixed["motor"].voltage[1:], 12 * duty[:-1], rtol=1e-12)
    assert_refused("supply_voltage", path, ["voltage=/duty.data:duty velocity=/speed.data"])


def test_velocity_is_converted_to_si_units_at_motor_shaft(tmp_path):
    messages = in_order(every_10_ms("/u", [1.0] * 9), every_10_ms("/w", [60.0] * 9))
    path = write_mcap(tmp_path / "bag.mcap", messages)

    def speed(spec: str) -> float:
        return float(read_records(path, f"voltage=/u.data {spec}")["motor"].velocity[0])

    assert speed("velocity=/w.data:rpm") == pytest.approx(2 * math.pi)
    assert speed("velocity=/w.data:rpm gear_ratio=10") == pytest.approx(20 * math.pi)
    assert speed("velocity=/w.data:rpm@motor gear_ratio=10") == pytest.approx(2 * math.pi)
    assert speed("velocity=/w.data:rpm gear_ratio=10 shaft=motor") == pytest.approx(2 * math.pi)
    assert speed("velocity=/w.data:deg/s") == pytest.approx(math.pi / 3)
    assert speed("velocity=/w.data*-1/2+10:deg/s") == pytest.approx(-math.pi / 9)
    # Ticks are counted at the motor unless said otherwise.
    ticks = "velocity=/w.data:ticks/s counts_per_revolution=120 gear_ratio=10"
    assert speed(ticks) == pytest.approx(math.pi)
    assert speed(ticks.replace("/s", "/s@wheel")) == pytest.approx(10 * math.pi)
    with pytest.raises(BagError, match="counts_per_revolution"):
        speed("velocity=/w.data:ticks/s")


@pytest.mark.parametrize(
    ("mapping", "reason"),
    [
        ("voltage=/nope.data velocity=/w.data", "has no /nope; it has /u, /w"),
        ("voltage=/u.nope velocity=/w.data", "field 'nope' does not exist: no 'nope' among data"),
        ("voltage=/u.data[0] velocity=/w.data", "is not an array"),
        ("voltage=/u.data", "gives no velocity, position or count"),
        ("velocity=/w.data", "gives no voltage"),
        ("voltage=u velocity=/w.data", "a topic for voltage"),
        ("voltage=/u.data velocity=/w.data clock=header", "no usable header time"),
    ],
)
def test_invalid_mapping_is_refused_with_available_fields(tmp_path, mapping, reason):
    messages = in_order(every_10_ms("/u", [1.0] * 9), every_10_ms("/w", [60.0] * 9))
    path = write_mcap(tmp_path / "bag.mcap", messages)
    assert_refused(re.escape(reason), path, mapping)


def test_messages_not_matching_their_type_are_removed_and_reported(tmp_path):
    truth = motion(n=100)
    messages = truth.messages()
    messages[50] = Sent(messages[50].topic, STATE, messages[50].stamp, b"\0\1\0\0rubbish")
    messages[70] = Sent(messages[70].topic, STATE, messages[70].stamp, b"")
    record = read(tmp_path / "bag.mcap", messages)
    assert len(record) == 98
    assert "2 messages are not of type smp_interfaces/msg/MotorState" in notes(record)


def test_the_topics_of_a_bag_are_listed(tmp_path):
    n = 30
    messages = in_order(
        every_10_ms("/left/pwm", np.arange(n)),
        every_10_ms("/right/pwm", np.arange(n)),
        every_10_ms("/temperature", np.arange(n)),
        joint_states(lambda _: ["left_wheel", "right_wheel"], [[1.0, 2.0]] * n),
    )
    path = write_mcap(tmp_path / "bag.mcap", messages)
    listing = list_topics(path)[0]
    assert listing.needs_mapping
    topics = {info.topic: info for info in listing.topics}
    assert topics["/joint_states"].fields == ["velocity[left_wheel]", "velocity[right_wheel]"]
    assert topics["/temperature"].count == n
    assert topics["/temperature"].rate == pytest.approx(100.0)
    assert listing.suggestion == []  # no speed follows these voltages


def test_our_own_messages_need_no_mapping(tmp_path):
    path = write_mcap(tmp_path / "bag.mcap", motion(n=20, bits=16).messages())
    listing = list_topics(path)[0]
    assert not listing.needs_mapping
    assert listing.suggestion == []
    hardware = read_records(path)["front_left"].hardware
    assert hardware.gear_ratio == RATIO
    assert hardware.counts_per_revolution == COUNTS
    assert (hardware.encoder_bits, hardware.supply_voltage, hardware.resistance) == (16, 12.0, None)
    given = read_records(path, ["gear_ratio=10", "resistance=1.5"])["front_left"].hardware
    assert (given.gear_ratio, given.resistance, given.encoder_bits) == (10.0, 1.5, 16)


def test_missing_motor_description_is_reported(tmp_path):
    messages = motion(n=20).messages(description=False)
    record = read(tmp_path / "bag.mcap", messages)
    assert "no motor_description; a gear ratio of 1 is assumed" in notes(record)
