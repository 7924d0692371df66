"""What a driver makes of its command is estimated beside the motor, declared, and designed for."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from driven import (
    DRIVERS,
    GAIN,
    NOISE,
    STATIC,
    STEP,
    TAU,
    commands,
    estimated,
    recorded,
    run,
    slewed,
)

from smp_motor_ident.errors import ParameterError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation import driver_joint
from smp_motor_ident.estimation.driver_effect import (
    driver_of,
)
from smp_motor_ident.estimation.driver_rows import emf_share, measured_speed
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.driver_feedback import terminal_voltages
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model import driver
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.driver import Driver, terminal_voltage
from smp_motor_ident.model.measurement import SPEED
from smp_motor_ident.model.physical import from_physical
from smp_motor_ident.model.structures import Electromechanical, SecondOrder
from smp_motor_ident.record import Record
from smp_motor_ident.tune.designer import design
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.writing import parameters


@pytest.mark.parametrize("name", DRIVERS)
def test_motor_and_driver_are_both_found(name):
    truth = {"dc_gain": GAIN, "time_constant": TAU, "static_voltage": STATIC}
    truth[name] = DRIVERS[name][1]
    errors = []
    for seed in range(3):
        found = estimated(name, seed)
        assert not found.unreliable
        errors.append(
            [(found.combinations[n].value - v) / found.combinations[n].std
             for n, v in truth.items()]
        )  # fmt: skip
    errors = np.array(errors)
    assert np.abs(errors).max() < 4.0
    assert 0.4 < np.sqrt(np.square(errors).mean()) < 1.6  # neither too narrow nor too wide


def test_steps_of_one_size_through_a_ramp_are_no_second_lag_under_a_load_that_fluctuates():
    rng, rate, fine = np.random.default_rng(5), 1000, 10
    levels = 1.4 * np.array([1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1, 2, 3, 4, 5, 6])
    command = np.repeat(levels, 300)
    volts, w, angle = 1.4, GAIN * (1.4 - STATIC), 0.0
    most, keep = 110.0 / rate / fine, math.exp(-1 / rate / fine / TAU)
    position = []
    for target in command.tolist():
        position.append(angle)
        for _ in range(fine):
            volts += min(max(target - volts, -most), most)
            w = keep * w + (1 - keep) * GAIN * (volts - STATIC)
            angle += w / rate / fine
        w += 0.02 * rng.standard_normal()
    angles = np.array(position) + 1e-3 * rng.standard_normal(len(position))
    time = np.arange(command.size) / rate
    found = estimate(Record("motor", time, command, position=angles))
    for name, value in {"dc_gain": GAIN, "time_constant": TAU, "slew_rate": 110.0}.items():
        quantity = found.combinations[name]
        assert abs(quantity.value - value) < 4 * quantity.std + 0.005 * value, name


def test_a_rise_begins_from_nothing_where_the_motor_begins_at_rest():
    first = np.array([True, False, False])
    for emf, expected in ((0.0, [0.0, 2.5, 7.5]), (9.0, [10.0, 10.0, 10.0])):
        rows = driver.Rows(np.full(3, 10.0), np.full(3, emf), np.full(3, 0.1), first, 0.1)
        assert rows.through(Driver(driver.SLEW, 50.0)) == pytest.approx(expected)


@pytest.mark.parametrize("levels", [(8, 3, 10, 5, 12, 7, 2, 9), (9, -4, 6, 12, -10, 3, -7)])
def test_a_rise_as_slow_as_the_motor_is_no_lag_of_it(levels):
    """The command is there in the first row, the voltage is not: the motor begins at rest."""
    command = np.repeat(np.array(levels, dtype=float), 120)
    speed = run(slewed(command, 80.0), 0)
    record = Record("motor", np.arange(command.size) * STEP, command, velocity=speed)
    found = estimate(record)
    for name, true in {"time_constant": TAU, "slew_rate": 80.0}.items():
        q = found.combinations[name]
        # 4 standard deviations; a two-hundredth besides, of what lies between the rows.
        assert abs(q.value - true) < max(4 * q.std, 0.005 * true)
        assert abs(q.value / true - 1) < 0.02


def test_a_clip_just_below_the_largest_command_is_found():
    command = commands(0)
    limit = 0.97 * np.abs(command).max()
    time = np.arange(command.size) * STEP
    speed = run(np.clip(command, -limit, limit), 0)
    found = estimate(Record("motor", time, command, velocity=speed))
    clip, gain = (found.combinations[n] for n in ("clip_voltage", "dc_gain"))
    assert abs(clip.value - limit) < 4 * clip.std < 0.02 * limit
    assert abs(gain.value - GAIN) < 4 * gain.std


def test_an_effect_in_volts_is_smaller_than_the_command():
    rows = driver.Rows(np.array([-6.0, 4.0]), np.zeros(2), np.ones(2), np.zeros(2, bool), 0.1)
    for effect in driver.EFFECTS:
        volts = effect.quantity in ("dead_zone", "clip_voltage", "brush_drop")
        # What brakes is twice; no transistor takes half.
        most = {"current_limit_voltage": 12.0, "brush_drop": 2.4}.get(effect.quantity, 6.0)
        assert effect.may_be(most - 0.1, rows)
        assert effect.may_be(most + 0.1, rows) is not (volts or most > 6.0)


def test_a_driver_that_limits_the_current_is_found_and_designed_for():
    """It looks like a hand that holds the motor at every large step."""
    command = commands(1)
    record = Record("motor", np.arange(command.size) * STEP, command, velocity=run(command, 1, 4.0))
    found = estimate(record)
    truth = {"dc_gain": GAIN, "time_constant": TAU, "current_limit_voltage": 4.0}
    for name, value in truth.items():
        q = found.combinations[name]
        assert abs(q.value - value) < max(4 * q.std, 0.01 * value) and q.std < 0.02 * value, name
    assert found.combinations["current_limit_voltage"].std > 0.01 * 4.0  # as it is built
    one = design(found, Loop(sample_time=STEP, gear_ratio=1.0, counts_per_revolution=None))
    able = (4.0 - STATIC) * GAIN / TAU  # rad/s^2 from the current there is
    assert 0.8 * able < one.reference.max_acceleration < able


def test_the_motion_of_each_record_is_its_own():
    record = recorded("dead_zone", 0)
    for one in (record, replace(record, velocity=None, position=np.cumsum(record.velocity) * STEP)):
        alone = measured_speed(prepare([one], False), TAU)
        both = measured_speed(prepare([one, one], False), TAU)
        assert both == pytest.approx(np.tile(alone, 2), abs=NOISE)
        # A mean over a fifth of the lag.
        assert np.abs(alone - record.velocity).std() < 0.1 * record.velocity.std()


def test_a_segment_without_a_reading_stands():
    """A timer of edges has none while the motor stands."""
    record = recorded("dead_zone", 0)
    lost = np.arange(len(record)) < 200
    record = replace(record, velocity=np.where(lost, np.nan, record.velocity), starts=(0, 200))
    speed = measured_speed(prepare([record], False), TAU)
    assert not speed[lost].any() and np.isfinite(speed).all() and speed[~lost].any()


def test_a_plain_driver_has_no_effect():
    command = commands(5)
    time = np.arange(command.size) * STEP
    found = estimate(Record("motor", time, command, velocity=run(command, 5)))
    assert driver_of(found).kind == driver.NOTHING
    assert not set(DRIVERS) & set(found.combinations)


def test_a_declared_driver_is_taken_for_known():
    found = estimate(recorded("dead_zone", 0), fixed={"dead_zone": 1})
    zone = found.combinations["dead_zone"]
    assert (zone.value, zone.std, zone.status) == (1.0, None, "fixed")
    gain = found.combinations["dc_gain"]
    assert abs(gain.value - GAIN) < 4 * gain.std
    assert driver_of(found) == Driver(driver.DEAD_ZONE, 1.0, np.abs(commands(0)).max())
    with pytest.raises(ParameterError, match="dead_zone = -1"):
        estimate(recorded("dead_zone", 0), fixed={"dead_zone": -1.0})


def test_a_declared_clip_holds_for_held_out_records():
    records = [recorded("clip_voltage", seed) for seed in (0, 1)]
    found = estimate(records[:1], fixed={"clip_voltage": 9.0}, validation=records[1:])
    assert found.fit_percent.validation > 98.5
    assert estimate(records[:1], validation=records[1:]).fit_percent.validation > 98.5


def test_gains_are_for_motor_and_driver():
    loop = Loop(sample_time=STEP, gear_ratio=1.0, counts_per_revolution=None, supply_voltage=12.0)
    zone = design(estimated("dead_zone", 0), loop)
    assert zone.gains.feedforward_static == pytest.approx(STATIC + 1.0, abs=0.05)
    size = {"size": 1.0, "full_duty": 12.0, "emf_share": 1.0}
    drop = Finding("brush_drop", "warning", "", size)
    dropped = design(replace(estimated("dead_zone", 0), findings=(drop,)), loop)
    assert dropped.gains.feedforward_static == pytest.approx(STATIC + 1.0, abs=0.05)
    clip = design(estimated("clip_voltage", 0), loop)
    assert clip.gains.u_clamp_max == pytest.approx(9.0, abs=0.05)
    slew = design(estimated("slew_rate", 0), loop)
    assert slew.loop.loop_delay == pytest.approx(STEP + 0.5 * 12.0 / 200.0, abs=1e-3)


def test_a_wheel_that_its_driver_holds_back_is_no_stall():
    """Feed-forward knows no driver that coasts: the integral passes the usual 4 V on its way."""
    loop = Loop(sample_time=STEP, gear_ratio=1.0, counts_per_revolution=None, supply_voltage=12.0)
    plain = estimated("dead_zone", 0)
    assert "stall_voltage" not in parameters(design(plain, loop))
    coast = Finding("coast", "warning", "", {"size": 4.0, "full_duty": 12.0, "emf_share": 1.0})
    must_turn = parameters(design(replace(plain, findings=(coast,)), loop))["stall_voltage"]
    # The mean of the current's triangle from rest: v^2 / (size supply), less what decays meanwhile.
    assert 4.0 < math.sqrt(STATIC * 4.0 * 12.0) < must_turn < 5.0
    short, enough = (
        terminal_voltage(Driver(driver.COAST, 4.0, 12.0), share * must_turn, 0.0, 0.0, STEP)[0]
        for share in (0.95, 1.05)
    )
    assert short < STATIC < enough


@pytest.mark.parametrize("name", DRIVERS)
def test_what_a_known_driver_does_is_not_unmodelled(name):
    """A motor behind it answers as its model says: the loop is simulated with both."""
    error = estimated(name, 0).residuals.model_error
    shown = np.array(error.shown)[np.array(error.frequency) < 1 / TAU]
    assert shown.size and shown.max() < 0.02


@pytest.mark.parametrize(
    ("kind", "size", "command", "back_emf", "expected"),
    [
        (driver.NOTHING, 0.0, 3.0, 1.0, 3.0),
        (driver.DEAD_ZONE, 0.5, -3.0, 1.0, -2.5),
        (driver.DEAD_ZONE, 0.5, 0.4, 1.0, 0.0),
        (driver.CLIP, 2.0, -3.0, 1.0, -2.0),
        (driver.SAG, 1.0, 5.0, 1.0, 1.0 + 4.0 / 1.25),  # half duty: a quarter of the resistance
        (driver.DROP, 0.5, 3.0, 1.0, 2.5),
        (driver.DROP, 0.5, 1.2, 1.0, 1.0),  # no current flows
        (driver.CURRENT, 0.5, 3.0, 1.0, 1.5),
        (driver.CURRENT, 0.5, -3.0, 1.0, 0.5),  # it brakes
        (driver.COAST, 1.0, 0.0, 4.0, 4.0),  # a motor that runs free
        (driver.COAST, 1.0, 10.0, 4.0, 10.0),
    ],
)
def test_voltage_at_the_terminals(kind, size, command, back_emf, expected):
    mean, end = terminal_voltage(Driver(kind, size, 10.0), command, back_emf, 0.0, STEP)
    assert mean == pytest.approx(expected)
    assert end == mean


def test_a_slew_limit_remembers_where_it_was():
    limited = Driver(driver.SLEW, 100.0, 10.0)
    assert terminal_voltage(limited, 3.0, 0.0, 1.0, 0.01) == pytest.approx((1.5, 2.0))
    assert terminal_voltage(limited, 1.5, 0.0, 1.0, 0.01) == pytest.approx((1.375, 1.5))


def test_no_driver_is_found_that_leaves_nothing_of_the_record():
    """Current flows in the on-time alone; 26 levels one way look clipped at the lowest, too."""
    rng = np.random.default_rng(1)
    duty = np.repeat(np.arange(26) / 25, 100)
    w, speed = 0.0, np.zeros(duty.size)
    for k in range(duty.size):
        drive = duty[k] * (12 - w / 4.5) * 4.5 - 0.12 * w - 2.0 * (w > 0 or duty[k] > 0.05)
        w = max(w + 0.01 / 0.15 * drive, 0.0)
        speed[k] = w + 0.2 * rng.standard_normal()
    voltage = np.r_[0.0, 12 * duty[:-1]]
    found = estimate(Record("motor", 0.01 * np.arange(duty.size), voltage, velocity=speed))
    gain = found.combinations["dc_gain"]
    right = gain.std and abs(gain.value - 4.5 / 1.12) < 5 * gain.std
    assert found.unreliable or (right and driver_of(found).kind == driver.COAST)


def test_a_second_lag_that_nothing_shows_ends_at_a_thousandth_of_a_row():
    # Far below it friction chatters at every stop: one estimate took minutes.
    command = commands(0)
    speed = run(command, 0)
    data = prepare(
        [Record("motor", np.arange(command.size) * STEP, command, velocity=speed)], False
    )
    motor = Coordinates(np.log(1 / GAIN), np.log(TAU / GAIN)).with_friction(STATIC)
    motor = motor.with_second_lag(1e-20)
    near = Fit(
        motor, np.zeros((1, 5)), NOISE**2 * np.eye(2), structure=SecondOrder(friction="symmetric"),
        gain=np.zeros((3, 2)), objective=1.0, deviance=0.0, information=np.eye(2),
        scores=np.zeros((0, 2)), passes=1, converged=True, samples=command.size, kind=SPEED,
    )  # fmt: skip
    coasting = Driver(driver.COAST, 1.0, 12.0, 0.9)
    problem = driver_joint._Problem(data, near, coasting)
    found = problem.descend(problem.start(motor, coasting), 3)
    z, _, _ = problem.unpacked(found.x)
    assert z.a2 / z.a1 > 0.9e-3 * STEP


def test_a_motor_that_viscous_friction_would_drive_does_not_run_away_behind_a_driver():
    """A descent may pass one: its back-EMF is more than the voltage that its speed needs."""
    t = np.arange(2000) / 200.0
    voltage = 6.0 * np.sign(np.sin(t))
    data = prepare([Record("motor", t, voltage, velocity=100.0 * np.sin(t))], False)
    z = from_physical(4.0, 0.01, 0.02, 2.4e-6, -7e-5, 0.01)
    motor = SimpleNamespace(structure=Electromechanical(), z=z)
    assert z.a0 < 0.02 / 3
    assert emf_share(motor) == 1.0
    limited = Driver(driver.CURRENT, 2.5, 6.0, emf_share(motor))
    found = terminal_voltages(data, motor.structure, z, data.initial, limited)
    # The command, and what it brakes by beside it, are all that there is.
    assert np.abs(found).max() < 2 * 6.0
