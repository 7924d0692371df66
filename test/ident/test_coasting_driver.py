"""A bridge that is off between its pulses is estimated together with its motor."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from independent import simulate

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation import driver_joint
from smp_motor_ident.estimation.driver_effect import driver_of
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model import driver
from smp_motor_ident.model.driver import Driver, terminal_voltage
from smp_motor_ident.model.structures import FirstOrder
from smp_motor_ident.record import Hardware, Record

STEP = 0.005


@pytest.mark.parametrize("ratio", [0.05, 0.4, 2.0, 20.0])
@pytest.mark.parametrize("duty", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("share", [-0.4, 0.0, 0.6])
def test_a_bridge_that_is_off_for_the_rest_of_each_period(ratio, duty, share):
    """A winding's current in small steps, against the supply through diodes while it is off."""
    supply, steps, current, volts, periods = 10.0, 2000, 0.0, 0.0, 1 + int(20 * ratio)
    keep, back = np.exp(-1 / (steps * ratio)), share * supply
    for k in range(periods * steps):
        on = k % steps < duty * steps
        applied = supply if on else -supply
        after = keep * current + (1 - keep) * (applied - back)  # times the resistance
        if not on and after < 0.0:
            applied, after = back, 0.0
        volts += applied * (k >= (periods - 1) * steps)
        current = after
    mean, _ = terminal_voltage(Driver(driver.COAST, ratio, supply), duty * supply, back, 0.0, STEP)
    assert mean == pytest.approx(volts / steps, abs=0.01 * supply)
    mirrored = terminal_voltage(
        Driver(driver.COAST, ratio, supply), -duty * supply, -back, 0.0, STEP
    )
    assert mirrored[0] == pytest.approx(-mean)


def coasting(
    seed: int,
    viscous: float,
    te: float = 1.5e-3,
    pwm: float = 500.0,
    fine: int = 400,
    diodes: float = 0.0,
) -> tuple[Record, dict[str, float]]:
    """Return a record of a bridge that is off between its pulses, by a fine grid, and its truth."""
    supply, resistance, constant, inertia = 12.0, 2.0, 0.05, 2e-4
    step, torque = 0.01, 0.012
    dt = step / fine
    rng = np.random.default_rng(seed)
    command = np.repeat(rng.uniform(-11.0, 11.0, 40), rng.integers(15, 40, 40))
    i = w = 0.0
    speed = np.zeros(command.size)
    for k, volts in enumerate(command.tolist()[1:], 1):
        duty, sign = abs(volts) / supply, math.copysign(1.0, volts)
        for n in range(fine):
            on = (n * dt * pwm) % 1.0 < duty
            applied = sign * supply if on else -math.copysign(supply + diodes, i)
            after = i
            if on or i != 0.0:
                after = i + dt / te * ((applied - constant * w) / resistance - i)
            if not on and i * after < 0.0:
                after = 0.0
            drive = constant * 0.5 * (i + after) - viscous * w
            i = after
            drag = math.copysign(torque, w) if w else min(max(drive, -torque), torque)
            turned = w + dt / inertia * (drive - drag)
            w = 0.0 if w * turned < 0.0 else turned
        speed[k] = w + 0.2 * rng.standard_normal()
    a0 = constant + resistance * viscous / constant
    truth = {
        "dc_gain": 1 / a0,
        "time_constant": (resistance * inertia / constant + te * (a0 - constant)) / a0,
        "static_voltage": torque * resistance / constant,
        "fast_decay_ratio": te * pwm,
    }
    return Record("motor", step * np.arange(command.size), command, velocity=speed), truth


@pytest.mark.parametrize(
    ("seed", "viscous", "pulses"), [(0, 1e-5, ()), (1, 2.5e-4, ()), (2, 1e-4, (0.02, 2e3, 800))]
)
def test_a_coasting_bridge_is_fitted_together_with_its_motor(seed, viscous, pulses):
    record, truth = coasting(seed, viscous, *pulses)
    if pulses:  # a current that hardly falls between them does not show how slowly it does
        del truth["fast_decay_ratio"]
    record = replace(record, hardware=replace(record.hardware, supply_voltage=12.0))
    found = estimate(record)
    assert not found.unreliable
    for name, value in truth.items():
        q = found.combinations[name]
        assert abs(q.value - value) < max(4 * q.std, 0.02 * value), name
        assert q.std < 0.2 * value
    behind = driver_of(found)
    assert not [f for f in found.findings if "supply_voltage" in f.advice]
    constant = 0.05 / (0.05 + 2.0 * viscous / 0.05)
    assert (behind.kind, behind.full_duty) == (driver.COAST, 12.0)
    assert behind.emf_share == pytest.approx(constant, abs=0.03)


@pytest.mark.parametrize(("seed", "viscous"), [(4, 2.5e-4), (6, 1e-4)])
def test_what_the_diodes_of_a_bridge_take_is_found(seed, viscous):
    """It had been taken for the motor's: time constants 3 to 5 % off, up to 4.7 deviations."""
    record, truth = coasting(seed, viscous, diodes=1.5)
    found = estimate(replace(record, hardware=replace(record.hardware, supply_voltage=12.0)))
    assert not found.unreliable
    for name, value in truth.items():
        q = found.combinations[name]
        assert abs(q.value - value) < 4 * q.std, name
    assert found.value("time_constant") == pytest.approx(truth["time_constant"], rel=0.025)
    assert driver_of(found).diode_drop == pytest.approx(1.5, abs=1.0)


def test_what_share_of_a_period_a_bridge_is_on_asks_for_the_supply():
    record, _ = coasting(0, 1e-5)
    assert not record.hardware.supply_voltage
    (found,) = [f for f in estimate(record).findings if f.code == "coast"]
    assert found.severity == "unreliable" and "supply_voltage" in found.advice


def test_the_speed_of_each_section_is_that_of_its_own_record():
    t = np.arange(200) * STEP
    record = Record("motor", t, np.full(200, 5.0), position=3.0 * np.arange(200.0))
    one = prepare([record, record], False)  # the second begins at the instant 0 again
    at_once = prepare([replace(record, time=t + t[-1]), record], False)
    for data in (one, at_once):
        speed = driver_joint._section_speeds(data, 10 * STEP)
        assert speed == pytest.approx(np.full(400, 3.0 / STEP), rel=1e-4)  # counts are dithered


def open_at_zero(command: np.ndarray, braked=()) -> tuple[Record, dict[str, float]]:
    """Return a record of a bridge that is open at a command of zero, and its truth.

    In the ``braked`` rows it drives at no voltage.
    """
    constant, resistance, inertia, viscous, torque = 0.05, 2.0, 2e-4, 2e-4, 0.01
    rng = np.random.default_rng(command.size)
    fine, w = 100, 0.0
    speed = np.zeros(command.size)
    for k, volts in enumerate(command.tolist()[1:], 1):
        for _ in range(fine):
            drives = volts or k in braked
            current = (volts - constant * w) / resistance if drives else 0.0
            drive = constant * current - viscous * w
            drag = math.copysign(torque, w) if w else min(max(drive, -torque), torque)
            turned = w + 0.01 / fine / inertia * (drive - drag)
            w = 0.0 if w * turned < 0.0 else turned
        speed[k] = w + 0.2 * rng.standard_normal()
    a0 = constant + resistance * viscous / constant
    truth = {
        "dc_gain": 1 / a0,
        "time_constant": resistance * inertia / constant / a0,
        "static_voltage": torque * resistance / constant,
        "coasting_share": constant / a0,
    }
    return Record("motor", 0.01 * np.arange(command.size), command, velocity=speed), truth


def _holds(found, truth, share):
    assert not found.unreliable
    for name, value in truth.items():
        q = found.combinations[name]
        std = q.std
        assert abs(q.value - value) < 4 * std, name
        assert std < share * value


@pytest.mark.parametrize("rests", [2, 8])
def test_a_bridge_that_is_open_at_a_command_of_zero_is_estimated_with_its_motor(rests):
    """Seldom it looks like a hand that turned the motor on, but one that a driver explains."""
    rng = np.random.default_rng(rests)
    levels = rng.choice([4.0, 9.0, -4.0, -9.0], 40)
    levels[np.linspace(5, 35, rests).astype(int)] = 0.0
    record, truth = open_at_zero(np.repeat(levels, rng.integers(20, 60, 40)))
    found = estimate(record)
    assert "disturbed" not in {f.code for f in found.findings}
    _holds(found, truth, 0.05)
    assert driver_of(found).kind == driver.FREE


def test_one_step_and_how_the_motor_runs_down_tell_a_bridge_that_is_open_then():
    command = np.repeat([0.0, 9.0, 0.0], [50, 120, 250])
    record, truth = open_at_zero(command)
    found = estimate(record)
    _holds(found, truth, 0.1)
    codes = {f.code for f in found.findings}
    assert codes >= {"coast", "one_size_of_voltage"}  # of 9 V it is all the same
    record, truth = open_at_zero(command, range(170, 420))
    del truth["coasting_share"]
    braked = estimate(record)
    _holds(braked, truth, 0.1)
    assert "coast" not in {f.code for f in braked.findings}


@pytest.mark.parametrize(
    ("volts", "per_turn", "phase"), [(8.0, 44, 0.0), (8.0, 64, 0.2), (7.0, 44, 0.2)]
)
def test_a_motor_that_runs_down_open_is_under_no_load_that_steps_nor_ahead(volts, per_turn, phase):
    """Of a step of forty rows either explains much of what few counts show."""
    resistance, constant, inertia, viscous, torque = 2.1735, 0.011288, 3.639e-6, 2.157e-6, 4.772e-3
    command, fine, w = np.repeat([0.0, volts, 0.0], [11, 50, 39]), 200, 0.0
    angle = np.zeros(command.size)
    for k, v in enumerate(command.tolist()[1:], 1):
        turned = 0.0
        for _ in range(fine):
            current = (v - constant * w) / resistance if v else 0.0
            drive = constant * current - viscous * w
            drag = math.copysign(torque, w) if w else min(max(drive, -torque), torque)
            after = w + 0.01 / fine / inertia * (drive - drag)
            after = 0.0 if w * after < 0.0 else after
            turned += 0.5 * (w + after) * 0.01 / fine
            w = after
        angle[k] = angle[k - 1] + turned
    count = np.floor(angle * per_turn / (2 * np.pi) + phase).astype(np.int64)
    speed = np.diff(count, prepend=count[0]) * 2 * np.pi / per_turn / 0.01
    hardware = Hardware(1.0, float(per_turn))
    time = 0.01 * np.arange(command.size)
    found = estimate(Record("motor", time, command, velocity=speed, count=count, hardware=hardware))
    a0 = constant + resistance * viscous / constant
    truth = {"dc_gain": 1 / a0, "time_constant": resistance * inertia / constant / a0}
    for name, value in truth.items():
        assert found.value(name) == pytest.approx(value, rel=0.02), name
    assert "coast" in {f.code for f in found.findings} and not found.unreliable


def test_a_bridge_that_coasts_is_found_in_few_simulations(monkeypatch):
    """Begun at motors of a regression, descents agree: several hundred, not several thousand."""
    record, truth = coasting(0, 1e-5)
    data, options, runs = prepare([record], False), Options(), Counter()
    near = initial_fit(data, FirstOrder(), options)
    whole = driver_joint.terminal_voltages

    def counted(*args):
        runs["simulations"] += 1
        return whole(*args)

    monkeypatch.setattr(driver_joint, "terminal_voltages", counted)
    sizes = next(e.shares for e in driver.EFFECTS if e.kind == driver.COAST)
    found = driver_joint.fitted(data, near, Driver(driver.COAST, 1.0, 12.0), options, sizes)
    assert found.driver.size == pytest.approx(truth["fast_decay_ratio"], rel=0.05)
    assert runs["simulations"] < 1000


@pytest.mark.parametrize(("friction", "unreliable"), [(7.0, True), (3.0, False)])
def test_a_motor_that_friction_nearly_holds_is_unreliable(friction, unreliable):
    """Of 12 V at most: what is left of a bridge that coasts moves a motor as a great friction."""
    rng = np.random.default_rng(2)
    v = np.repeat(rng.uniform(-12.0, 12.0, 60), rng.integers(20, 60, 60))
    made = simulate(np.arange(v.size) * STEP, v, 2.0, 1e-3, 0.05, 2e-4, 1e-5, friction * 0.025,
                    np.zeros(v.size), 40)  # fmt: skip
    speed = made[:, 1] + 0.3 * rng.standard_normal(v.size)
    found = estimate(Record("motor", np.arange(v.size) * STEP, v, velocity=speed))
    assert found.value("static_voltage") == pytest.approx(friction, abs=0.1)  # a hundredth of 12 V
    assert ("friction_dominates" in [f.code for f in found.findings]) is unreliable
    assert found.unreliable is unreliable
