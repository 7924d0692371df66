"""A driver whose voltage follows the motion is estimated together with its motor."""

import math

import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.driver_search import _Joint
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model import driver
from smp_motor_ident.model.driver import Driver, terminal_voltage
from smp_motor_ident.model.structures import FirstOrder
from smp_motor_ident.record import Record

RESISTANCE, CONSTANT, INERTIA, TORQUE = 2.0, 0.05, 2e-4, 0.01
STEP, FINE = 0.01, 50


def recorded(
    command: np.ndarray, of: Driver, viscous: float, noise: float
) -> tuple[Record, dict[str, float]]:
    """Return a record of a motor behind a driver, in small steps, and its truth."""
    a0 = CONSTANT + RESISTANCE * viscous / CONSTANT
    w, speed = 0.0, np.zeros(command.size)
    for k, volts in enumerate(command.tolist()[1:], 1):
        for _ in range(FINE):
            v, _ = terminal_voltage(of, volts, a0 * w, volts, STEP / FINE)
            drive = CONSTANT * (v - CONSTANT * w) / RESISTANCE - viscous * w
            drag = math.copysign(TORQUE, w) if w else min(max(drive, -TORQUE), TORQUE)
            turned = w + STEP / FINE / INERTIA * (drive - drag)
            w = 0.0 if w * turned < 0.0 else turned
        speed[k] = w + noise * np.random.default_rng(k).standard_normal()
    truth = {
        "dc_gain": 1 / a0,
        "time_constant": RESISTANCE * INERTIA / CONSTANT / a0,
        "static_voltage": TORQUE * RESISTANCE / CONSTANT,
    }
    return Record("motor", STEP * np.arange(command.size), command, velocity=speed), truth


def behind(kind: int, size: float, viscous: float) -> Driver:
    return Driver(kind, size, 12.0, 1 / (1 + RESISTANCE * viscous / CONSTANT**2))


@pytest.mark.parametrize(
    ("kind", "size", "quantity"),
    [(driver.DROP, 1.8, "brush_drop"), (driver.SAG, 0.4, "source_resistance_ratio"),
     (driver.CURRENT, 5.0, "current_limit_voltage")],
)  # fmt: skip
def test_viscous_friction_is_told_from_back_emf_by_what_the_driver_does(kind, size, quantity):
    """Of 10 V at steady speed 8 are back-EMF: what brakes and what drives is that one's matter."""
    rng = np.random.default_rng(kind)
    levels = np.append(12.0, rng.uniform(-12.0, 12.0, 39))
    command = np.repeat(levels, rng.integers(20, 60, 40))
    of = behind(kind, size, 0.25 * CONSTANT**2 / RESISTANCE)
    record, truth = recorded(command, of, 0.25 * CONSTANT**2 / RESISTANCE, 0.2)
    found = estimate(record)
    assert not found.unreliable
    for name, value in {**truth, quantity: size}.items():
        q = found.combinations[name]
        assert abs(q.value - value) < max(4 * q.std, 0.01 * value), name
        assert q.std < 0.1 * value, name


def test_a_step_and_how_it_ends_tell_a_drop_from_friction():
    command = np.repeat([0.0, 9.0, 0.0], [50, 120, 250])
    record, truth = recorded(command, behind(driver.DROP, 1.2, 1e-4), 1e-4, 0.2)
    found = estimate(record)
    assert not found.unreliable
    assert "brush_drop" in found.combinations
    for name in ("dc_gain", "time_constant"):
        assert found.value(name) == pytest.approx(truth[name], rel=0.05), name
    static = found.combinations["static_voltage"]
    assert abs(static.value - truth["static_voltage"]) < 4 * static.std


@pytest.mark.parametrize(("levels", "brakes"), [((3, 5, 7, 9), False), ((9, 3, 7, 0), True)])
def test_a_drop_is_sought_only_where_the_motor_brakes(levels, brakes):
    """Of one that is only driven a drop and friction are one voltage."""
    command = np.repeat(np.array([0.0, *levels]), 80)
    record, _ = recorded(command, behind(driver.DROP, 1.2, 1e-4), 1e-4, 0.2)
    options = Options()
    fit = initial_fit(prepare([record], False), FirstOrder(), options)
    assert fit is not None
    drop = next(e for e in driver.EFFECTS if e.kind == driver.DROP)
    found = _Joint([record], [record], fit, options, drop).best(math.inf)
    assert (found is not None) is brakes
