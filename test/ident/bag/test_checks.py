# SPDX-License-Identifier: Apache-2.0
"""Detection of signals that contradict their mapping."""

from pathlib import Path

import numpy as np
import pytest
from recordings import (
    START,
    TYPES,
    Sent,
    assert_refused,
    codes,
    floats,
    follow,
    in_order,
    read,
    read_one,
    read_table,
    serialized,
    write_table,
)

from smp_motor_ident.errors import BagError
from smp_motor_ident.record import Record

N = 400
T = 0.01 * np.arange(N)
RNG = np.random.default_rng(8)
U = np.repeat(RNG.uniform(-6, 6, N // 20), 20)
SPEED = follow(U)
MAP = ["voltage=u velocity=y time=t"]


def test_velocity_outliers_are_removed(tmp_path):
    speed = SPEED.copy()
    speed[100], speed[200] = 1e200, speed[200] + 500  # corrupted exponent, corrupted mantissa
    record = read_table(tmp_path, MAP, t=T, u=U, y=speed)
    assert np.flatnonzero(np.isnan(record.velocity)).tolist() == [100, 200]
    assert "impossible_jump" in codes(record)


@pytest.mark.parametrize("shape", ["pulses", "steps", "quantised", "rest"])
def test_valid_motion_loses_no_sample_as_outlier(tmp_path, shape):
    voltage, speed = U.copy(), SPEED.copy()
    if shape == "pulses":
        voltage = np.where(np.arange(N) % 50 == 0, 12.0, 0.0)
    elif shape == "quantised":
        speed = np.rint(speed / 40) * 40
    elif shape == "rest":
        voltage[:350], speed[:350] = 0.0, 0.0
    assert "impossible_jump" not in codes(read_table(tmp_path, MAP, t=T, u=voltage, y=speed))


COUNT = np.rint(np.cumsum(SPEED) * 0.01 * 500 / (2 * np.pi)).astype(np.int64)


def read_count(folder: Path, count: np.ndarray, bits: int = 0) -> Record:
    mapping = f"voltage=u count=n time=t counts_per_revolution=500 encoder_bits={bits}"
    return read_table(folder, [mapping], t=T, u=U, n=count)


@pytest.mark.parametrize("spoilt", [-(1 << 62), 3 << 40, 3 << 20])
def test_sample_with_count_outlier_is_removed(tmp_path, spoilt):
    count = COUNT.copy()
    count[150] += spoilt
    record = read_count(tmp_path, count)
    assert "impossible_jump" in codes(record)
    np.testing.assert_array_equal(record.count, np.delete(COUNT, 150))


def test_counter_oscillating_across_its_wrap_loses_no_sample(tmp_path):
    to_and_fro = np.rint(30 * np.sin(0.4 * np.arange(N))).astype(np.int64)
    to_and_fro[: N // 2] = 1000  # most steps are zero
    record = read_count(tmp_path, to_and_fro % (1 << 16), 16)
    assert "impossible_jump" not in codes(record)
    assert record.count is not None and record.count.size == N
    np.testing.assert_array_equal(np.diff(record.count), np.diff(to_and_fro))


@pytest.mark.parametrize("every", [2, 3])
def test_count_alternating_between_two_publishers_is_refused(tmp_path, every):
    count = COUNT.copy()
    count[::every] = 70_000  # a forgotten node whose motor is at rest
    with pytest.raises(BagError, match=r"alternates between two counters.*two nodes published it"):
        read_count(tmp_path, count)
    count[::every] = COUNT[::every] + 900  # within the motion of one sample
    read_count(tmp_path, count)


@pytest.mark.parametrize("kind", ["armature", "offset", "without sign", "supply"])
def test_unsigned_current_is_dropped_and_velocity_kept(tmp_path, kind):
    speed = SPEED
    armature = (U - 0.045 * speed) / 2 + 0.05 * np.sign(speed) + RNG.normal(0, 0.01, N)
    current = {
        "armature": armature,
        "offset": armature + 0.1,
        "without sign": np.abs(armature),
        "supply": armature * U / 12,
    }[kind]
    record = read_table(tmp_path, [*MAP, "current=i"], t=T, u=U, y=speed, i=current)
    dropped = kind in ("without sign", "supply")
    assert ("unsigned_current" in codes(record)) is dropped
    assert (record.current is None) is dropped
    assert record.velocity is not None and np.isfinite(record.velocity).all()


@pytest.mark.parametrize("levels", [(0, 1), (-1, 1)])
def test_voltage_sign_is_taken_from_direction_column(tmp_path, levels):
    direction = np.where(U > 0, levels[1], levels[0])
    columns = dict(t=T, pwm=np.abs(U) / 12 * 255, dir=direction, y=SPEED)
    mapping = ["voltage=pwm:pwm direction=dir velocity=y time=t supply_voltage=12"]
    record = read_table(tmp_path, [*mapping, "pwm_full_scale=255"], **columns)
    np.testing.assert_allclose(record.voltage[1:], U[:-1], rtol=1e-12)
    assert_refused("needs pwm_full_scale", tmp_path / "log.csv", mapping)


@pytest.mark.parametrize("codes_of", [("F", "R"), ("fwd", "rev"), ("forwards", "backwards")])
def test_direction_is_read_from_words(tmp_path, codes_of):
    ways = [codes_of[0] if u > 0 else codes_of[1] for u in U]
    record = read_table(tmp_path, [*MAP, "direction=dir"], t=T, u=np.abs(U), dir=ways, y=SPEED)
    np.testing.assert_allclose(record.voltage[1:], U[:-1], rtol=1e-12)


@pytest.mark.parametrize("still", [0, 1])  # a third code for standstill
def test_ambiguous_direction_codes_are_refused(tmp_path, still):
    volts = U * (np.arange(N) % 40 >= 20 * still)
    direction = np.select([volts > 0, volts < 0], [1, 2], 0)
    path = write_table(tmp_path / "log.csv", t=T, u=np.abs(volts), dir=direction, y=SPEED)
    assert_refused("1, 2, and which is backwards is unknown", path, [*MAP, "direction=dir"])
    record = read_one(path, [*MAP, "direction=dir*-1+1.5"])
    np.testing.assert_allclose(record.voltage[1:], volts[:-1], rtol=1e-12)


def test_pwm_beyond_full_scale_is_clipped_to_supply_voltage(tmp_path):
    rng = np.random.default_rng(5)
    pwm = rng.integers(-255, 256, 400)
    pwm[100:110] = 1000  # an unclipped controller output, or an error code
    mapping = "time=t voltage=pwm:pwm velocity=w pwm_full_scale=255 supply_voltage=12 held=after"
    record = read_table(tmp_path, [mapping], t=T, pwm=pwm, w=10 * T)
    # A value held from its row on is the mean of the interval to the next row.
    np.testing.assert_allclose(record.voltage[1:], np.clip(pwm / 255 * 12, -12, 12)[:-1])
    (found,) = (f for f in record.findings if f.code == "beyond_full_scale")
    assert found.evidence["samples"] == 10
    assert "392 %" in found.message


def write_signed_command(folder: Path, direction: str) -> Path:
    """Write a signed command and a direction column."""
    rng = np.random.default_rng(4)
    pwm = np.repeat(rng.choice([-80, -40, 0, 40, 80], 30), 20)
    words = {1: "FWD", 0: "FWD", -1: "REV"}
    way = [words[int(np.sign(p))] if direction == "own" else "FWD" for p in pwm]
    time = 0.01 * np.arange(pwm.size)
    return write_table(folder / "log.csv", t=time, pwm=pwm, way=way, w=0.3 * pwm)


@pytest.mark.parametrize("direction", ["own", "one"])
def test_direction_column_is_ignored_for_signed_command(tmp_path, direction):
    path = write_signed_command(tmp_path, direction)
    mapping = ["voltage=pwm:% supply_voltage=12 velocity=w time=t"]
    plain, record = (read_one(path, [*mapping, *more]) for more in ((), ("direction=way",)))
    np.testing.assert_array_equal(record.voltage, plain.voltage)
    assert "leave it out" in next(
        f.message for f in record.findings if f.code == "direction_not_used"
    )


@pytest.mark.parametrize(
    ("field", "severity"),
    [
        ("/cmd_vel.linear.x", "unreliable"),
        ("/cmd_vel.linear.x*24", "warning"),
        ("/motor/speed_cmd.data", "unreliable"),
        ("/motor/pwm_cmd.data", None),
    ],
)
def test_speed_command_mapped_as_voltage_is_reported(tmp_path, field, severity):
    twist, vector = "geometry_msgs/msg/Twist", TYPES.types["geometry_msgs/msg/Vector3"]
    topic, values = field.split(".")[0], np.arange(200) // 20 % 3
    at = START + 10**7 * np.arange(200)
    commands = floats(topic, at, values)
    if topic == "/cmd_vel":
        given = ((vector(v, 0, 0), vector(0, 0, 0)) for v in values.astype(float).tolist())
        bodies = (serialized(twist, linear=v, angular=w) for v, w in given)
        commands = [Sent(topic, twist, int(t), body) for t, body in zip(at, bodies)]
    sent = in_order(commands, floats("/w", at, values))
    record = read(tmp_path / "bag.mcap", sent, [f"voltage={field} velocity=/w.data"])
    found = [f.severity for f in record.findings if f.code == "speed_command"]
    assert found == ([] if severity is None else [severity])


@pytest.mark.parametrize("still", [False, True])
def test_velocity_of_zero_during_motion_is_dropped(tmp_path, still):
    """UbiquityRobotics/ubiquity_motor issue 59: the position moves, the velocity is 0."""
    angle = np.zeros(N) if still else 0.01 * np.cumsum(SPEED)
    mapping = ["voltage=u position=p velocity=w time=t"]
    record = read_table(tmp_path, mapping, t=T, u=U, p=angle, w=0 * angle)
    assert (record.velocity is None) is not still
    assert ("velocity_not_filled" in codes(record)) is not still
