# SPDX-License-Identifier: Apache-2.0
"""All components that a chain may have, the only table of effects."""

from __future__ import annotations

from smp_motor_ident.chain import driver, motor, sensor
from smp_motor_ident.chain.chain import Chain
from smp_motor_ident.chain.component import Component
from smp_motor_ident.result import ChainRecord

MOTORS: tuple[Component, ...] = (
    motor.FirstOrder(), motor.SecondOrder(), motor.Electromechanical(),
)  # fmt: skip
OPTIONAL: tuple[Component, ...] = (
    motor.Friction(), motor.Load(), motor.Delay(), motor.AsymmetricFriction(),
    driver.DeadZone(), driver.HardDeadZone(), driver.Clip(), driver.WeakSide(), driver.Slew(),
    driver.Sag(), driver.Drop(),
    driver.CurrentLimit(), driver.FastDecay(), driver.FreeAtZero(), driver.Decline(),
    motor.Drag(), motor.Stribeck(), motor.FrictionDrift(), motor.LoadStep(),
)  # fmt: skip
SPEED_SENSORS: tuple[Component, ...] = (sensor.MeanSpeed(), sensor.LowPassedSpeed())
ANGLE_SENSORS: tuple[Component, ...] = (sensor.EccentricAngle(),)
CURRENT_SENSORS: tuple[sensor.Current, ...] = (
    sensor.Current(), sensor.MeanCurrent(), sensor.LowPassedCurrent(), sensor.SmoothedCurrent(),
    sensor.UnsignedCurrent(), sensor.SupplyCurrent(),
)  # fmt: skip
GIVEN: dict[str, tuple[Component, str]] = {
    "delay": (motor.Delay(), "delay"),
    "averaging_window": (sensor.MeanSpeed(), "window"),
    "sensor_lag": (sensor.LowPassedSpeed(), "sensor_lag"),
    "dead_zone": (driver.DeadZone(), "dead_zone"),
    "clip_voltage": (driver.Clip(), "clip_voltage"),
    "slew_rate": (driver.Slew(), "ramp_time"),
}
"""Quantities that a user may know of driver and sensors: component and parameter."""
ALL: tuple[Component, ...] = (
    *MOTORS, *OPTIONAL, sensor.Speed(), sensor.DifferencedSpeed(), sensor.Angle(),
    *SPEED_SENSORS, *ANGLE_SENSORS, *CURRENT_SENSORS,
)  # fmt: skip


def rebuild_chain(record: ChainRecord) -> Chain:
    """Return the chain that plain data describe."""
    components = tuple(one for code in record.components if (one := find_component(code)))
    return Chain(components, dict(record.values))


def find_component(code: str) -> Component | None:
    """Return the component of a code."""
    return next((one for one in ALL if one.code == code), None)
