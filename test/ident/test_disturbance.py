"""A hand on a wheel, an obstacle: the part that tells of no motor is left out, and said to be."""

import math
import re

import independent
import numpy as np
import pytest

from smp_motor_ident.errors import SignalError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation import order_selection
from smp_motor_ident.estimation.disturbance import disturbance
from smp_motor_ident.estimation.fit import Options, Start, solve
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.structures import FirstOrder
from smp_motor_ident.record import Hardware, Record

GAIN, TAU, STATIC, STEP, COUNTS = 18.0, 0.09, 0.5, 0.005, 1024
ROWS = 4_000


def moved(speed: float, net: float, left: float) -> tuple[float, float, float]:
    """Return speed, angle and time left after a motor ran under a voltage until it stood.

    ``tau w' = gain (net - static sign w) - w``, in closed form.
    """
    if speed == 0.0 and abs(net) <= STATIC:
        return 0.0, 0.0, 0.0
    way = math.copysign(1.0, speed if speed else net)
    steady = GAIN * (net - STATIC * way)
    standing = TAU * math.log((steady - speed) / steady) if steady * speed < 0 else math.inf
    time = min(standing, left)
    after = 0.0 if standing <= left else steady + (speed - steady) * math.exp(-time / TAU)
    return after, steady * time + TAU * (speed - after), left - time


def recorded(seed: int, *, held=(), noise: float = 0.0, drift: float = 0.0) -> Record:
    """Return counts of a motor of first order that stands still while it is held [s]."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-9.0, 9.0, ROWS // 40), 40)
    load = noise * rng.standard_normal(ROWS) + drift * np.arange(ROWS) / ROWS
    return counted(voltage, load, STEP, COUNTS, held)


def counted(voltage, load, step: float, counts: int, held=()) -> Record:
    """Return counts of a motor of first order under a voltage less a load [V]."""
    speed, angles = 0.0, np.zeros(voltage.size)
    for k in range(1, voltage.size):
        left, angle = step, angles[k - 1]
        if any(a <= k * step < b for a, b in held):
            left = speed = 0.0
        while left > 0.0:
            speed, turned, left = moved(speed, voltage[k] - load[k], left)
            angle += turned
        angles[k] = angle
    count = np.floor(angles * counts / (2 * math.pi)).astype(np.int64)
    hardware = Hardware(counts_per_revolution=counts)
    return Record("motor", step * np.arange(voltage.size), voltage, count=count, hardware=hardware)


def rested(record: Record, seconds: float) -> Record:
    """Return a record with a rest before it."""
    rows = round(seconds / STEP)
    return Record(
        record.wheel,
        STEP * np.arange(rows + len(record)),
        np.pad(record.voltage[1:], (rows + 1, 0)),
        count=np.pad(record.count, (rows, 0)),
        hardware=record.hardware,
    )


def spans(words: Finding) -> list[tuple[float, float]]:
    found = re.findall(r"from (\S+) s to (\S+) s", words.message)
    return [(float(a), float(b)) for a, b in found]


@pytest.mark.parametrize("seed", range(3))
def test_what_a_hand_did_is_left_out_and_the_rest_tells_the_motor(seed):
    found = estimate(recorded(seed, held=[(8.0, 8.6)]))
    (words,) = [f for f in found.findings if f.code == "disturbed"]
    ((begin, end),) = spans(words)
    assert begin <= 8.0 < 8.6 <= end < begin + 0.2 * ROWS * STEP
    assert not found.unreliable
    truth = {"dc_gain": GAIN, "time_constant": TAU, "static_voltage": STATIC}
    for name, value in truth.items():
        quantity = found.combinations[name]
        assert abs(quantity.value - value) < 4 * quantity.std < 0.1 * value


def test_the_time_is_the_records_own():
    record = rested(recorded(4, held=[(8.0, 8.6)]), 15.0)
    (words,) = [f for f in estimate(record).findings if f.code == "disturbed"]
    ((begin, end),) = spans(words)
    assert begin <= 23.0 < 23.6 <= end < begin + 4.0


def test_each_of_two_accidents_is_left_out():
    there = disturbance([recorded(5, held=[(4.0, 4.3), (14.0, 14.3)])], [0.0])
    assert there is not None
    (a, b), (c, d) = there.spans
    assert a <= 4.0 < 4.3 <= b < c <= 14.0 < 14.3 <= d
    (rest,) = there.records
    assert rest.starts[0] == 0 and len(rest.starts) > 2
    assert not np.any((rest.time >= a) & (rest.time <= b))


@pytest.mark.parametrize(
    "kind", [{}, {"noise": 0.5}, {"drift": 2.0}], ids=["in order", "torque noise", "drift"]
)
@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_left_out_under_torque_noise_or_a_drift(seed, kind):
    assert disturbance([recorded(10 + seed, **kind)], [0.0]) is None


@pytest.mark.parametrize("before", [42, 45, 48])
def test_a_part_that_begins_where_the_motor_turns_back_is_no_accident(before):
    """Coarse counts do not tell which way it turned when a part of 400 rows began."""
    time = np.arange(12_000)
    voltage = np.where((time - 4000 + before) // 1700 % 2, -9.0, 9.0)
    record = counted(voltage, np.zeros(time.size), 1e-3, 48)
    assert disturbance([record], [0.0]) is None


def test_a_motor_that_something_holds_half_of_the_time_is_not_mended():
    held, said = [(n, n + 0.5) for n in range(8)], list[str]()
    with pytest.raises(SignalError):
        estimate(recorded(8, held=held), progress=said.append)
    # What the voltage does not explain no hold of it does: that search takes half of the time.
    assert "how the command ran between samples" not in said


def test_what_tells_the_motor_is_not_left_out_as_a_disturbance():
    """Of a sine only its beginning tells gain, friction and lag apart, were a part of it odd."""
    R, L, K, J, B, TC = 1.4946, 7.747e-3, 0.026169, 4.7487e-5, 5.776e-5, 3.872e-3
    rng = np.random.default_rng(1)
    t = np.arange(805) / 100
    volts = np.r_[0.0, 3.23 * np.sin(2 * np.pi * 2.0016 * t[:-1])]
    motion = independent.simulate(t, volts, R, L, K, J, B, TC, np.zeros(t.size), 50)
    exact = motion[:, 2] * 2000 / (2 * np.pi) + rng.uniform()
    way = np.diff(exact, prepend=exact[0])
    missed = np.cumsum(np.where(np.abs(way) > 0.5 * np.abs(way).max(), 0.003 * way, 0.0))
    count = np.floor(exact - missed).astype(np.int64)
    current = motion[:, 0] + 0.008 * rng.standard_normal(t.size)
    record = Record("motor", t, volts, count=count, current=current, hardware=Hardware(1.0, 2000.0))
    found = estimate(record)
    assert found.unreliable or abs(found.value("inductance") - L) < 0.1 * L
    gain = found.combinations["dc_gain"]
    assert found.unreliable or abs(gain.value - K / (K * K + R * B)) < 3 * gain.std


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_torque_noise_that_brought_a_fit_near_is_believed_only_where_there_is_some(noise):
    data = prepare([recorded(30, noise=noise)], False)
    near = Coordinates().with_(
        ln_a0=-math.log(GAIN), ln_a1=math.log(TAU / GAIN), vc_plus=STATIC, vc_minus=STATIC
    )
    start = Start(near, data.initial, np.diag([data.quantum**2 / 12, 1.0]), 1e4)
    brought = solve(data, FirstOrder(), start, Options())
    assert brought.noise_ratio > 0
    settled = order_selection._on_all(data, brought, [], Options())
    assert (settled.noise_ratio > 0) == (noise > 0)


def test_the_only_step_of_a_record_is_not_left_out_as_a_disturbance():
    """What follows a step for long, as a winding that heats, would be the motor's answer else."""
    rate, n, tau = 200.0, 4600, 0.45
    t = np.arange(n) / rate
    warm = 1 - 0.2 * (1 - np.exp(-3 * t / t[-1]))
    speed = 700 * warm * (1 - np.exp(-t / tau))
    noisy = speed + np.random.default_rng(6).standard_normal(n)
    record = Record("motor", t, np.full(n, 10.0), velocity=noisy)
    there = disturbance([record], [0.0])
    assert there is None or there.spans[0][0] > 5 * tau
