"""How a record begins: standing while it is driven, turning around, with an angle that is slow."""

from __future__ import annotations

import independent
import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.likelihood.experiments import angle_quantum, prepare
from smp_motor_ident.likelihood.noise import NoiseModel
from smp_motor_ident.likelihood.passes import evaluate
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.structures import FirstOrder, SecondOrder
from smp_motor_ident.record import Hardware, Record

RATE = 500.0
DEAD = 0.06  # s
MOTOR = 2.0, 2e-4, 0.05, 5e-5, 1e-5  # R, L, K, J, b
STATIC = 0.5  # V
LAG = (MOTOR[0] * MOTOR[3] + MOTOR[1] * MOTOR[4]) / (MOTOR[0] * MOTOR[4] + MOTOR[2] ** 2)


def stepped(*, angle: bool = False, before: float = 0.0, dead: float = DEAD) -> Record:
    """A step of 8 V in the first row that the motor hears late; before it another voltage."""
    rng = np.random.default_rng(2)
    n, early = 800, 400
    given = np.full(early + n, 8.0)
    given[: early + round(dead * RATE)] = before
    t = np.arange(given.size) / RATE
    coulomb = STATIC * MOTOR[2] / MOTOR[0]
    out = independent.simulate(t, given, *MOTOR, coulomb, np.zeros(t.size), 40)[early:]
    speed = out[:, 1] + 0.05 * rng.standard_normal(n)
    position = 2e-3 * np.round(out[:, 2] / 2e-3)
    kind = {"position": position} if angle else {"velocity": speed}
    return Record("wheel", t[:n], np.full(n, 8.0), **kind)


@pytest.mark.parametrize("angle", [False, True])
def test_a_motor_that_stands_under_its_first_voltage_hears_it_late(angle: bool) -> None:
    record = stepped(angle=angle)
    assert prepare([record], False).stood.all()
    found = estimate(record)
    delay, lag = found.combinations["delay"], found.combinations["time_constant"]
    assert delay.value == pytest.approx(DEAD, abs=1.0 / RATE)
    assert lag.value is not None and lag.std is not None
    # A model of one lag may count the winding's to the delay.
    assert abs(lag.value - LAG) < 4.0 * lag.std + MOTOR[1] / MOTOR[0]


@pytest.mark.parametrize("angle", [False, True])
def test_a_motor_that_turns_around_does_not_stand(angle: bool) -> None:
    backwards = stepped(angle=angle, before=-8.0, dead=0.0)
    speed = np.gradient(backwards.position, 1 / RATE) if angle else backwards.velocity
    around = int(np.argmax(speed > 0.0))
    cut = {"position": backwards.position[around:] - backwards.position[around]} if angle else {
        "velocity": backwards.velocity[around:]
    }  # fmt: skip
    record = Record("wheel", backwards.time[: len(backwards.time) - around],
                    backwards.voltage[around:], **cut)  # fmt: skip
    assert not prepare([record], False).stood.any()


def test_a_winding_begins_with_no_more_than_what_drives_it() -> None:
    stood, moved = prepare([stepped()], False), prepare([stepped(before=-8.0, dead=0.0)], False)
    # A tenth of the largest voltage where friction holds the motor, else twice it.
    assert stood.known_initial[0, 0] == pytest.approx(1 / 0.8**2)
    assert moved.known_initial[0, 0] == pytest.approx(1 / 16.0**2)
    assert not stood.known_initial[:, [1, 2, 4]].any()
    # A load of its own takes no more than the voltage.
    assert stood.known_initial[0, 3] == pytest.approx(1 / 8.0**2)


def test_a_winding_that_may_begin_as_it_likes_has_its_price() -> None:
    data = prepare([stepped()], False)
    z = Coordinates(*np.log([0.05, 0.05 * LAG, 0.05 * LAG * 1e-3, 1e-3]))
    second = SecondOrder(friction="none")
    first = FirstOrder(friction="none")
    noise = NoiseModel(np.diag([0.05**2, 1.0]))
    here = evaluate(data, second, z, data.initial, data.initial, noise)
    # A volt over the winding for a millisecond, and the speed falls off with the motor's lag.
    answer = 1e-3 / (0.05 * LAG) * np.exp(-data.time / LAG)
    information = np.square(answer / 0.05).sum() * 0.8**2
    assert here.occam == pytest.approx(np.log1p(information), rel=0.1)
    assert evaluate(data, first, z, data.initial, data.initial, noise).occam == 0.0


def test_the_steps_of_an_angle_show_though_few_rows_move() -> None:
    slow = 0.0245 * np.floor(np.linspace(0.0, 90.3, 40_000) ** 1.01)
    late = np.concatenate([np.zeros(30_000), slow])
    assert angle_quantum(late) == pytest.approx(0.0245)


def test_a_first_command_that_a_fine_counter_shows_to_come_late_was_none_before() -> None:
    """From rest, every row another voltage, each a sample late: none ran before the first."""
    n, rate, per_turn = 1500, 200.0, 20_000.0
    t = np.arange(n) / rate
    tones = (0.5, 1.1, 2.7, 5.1, 11.0, 23.0)
    volts = sum(1.5 * np.cos(2 * np.pi * f * t) for f in tones)
    ran = np.concatenate([[0.0, 0.0], volts[1:-1]])  # over the interval that ends at each row
    r, el, k, j, b = MOTOR
    out = independent.simulate(t, ran, r, el, k, j, b, STATIC * k / r, np.zeros(n), 100)
    count = np.floor(out[:, 2] * per_turn / (2 * np.pi)).astype(np.int64)
    record = Record("wheel", t, volts, count=count, hardware=Hardware(1.0, per_turn))
    assert prepare([record], False).stood.all()
    found = estimate(record).combinations
    assert found["delay"].value == pytest.approx(1 / rate, rel=1e-2)
    for name, true in (("time_constant", LAG), ("static_voltage", STATIC)):
        assert abs(found[name].value - true) < max(5 * found[name].std, 2e-3 * true), name
