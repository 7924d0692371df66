"""What real drives do and the plain motor does not, each as regressors for the model's error.

An effect adds ``sum c_j s_j(t)`` to the voltage, to the load torque (in volts, as a standing motor
would show it), to the measured output, or to the measured current.  The ``s_j`` are made of the
model's own free run, so they know nothing of the noise.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import SWING
from smp_motor_ident.likelihood.first_order_lag import lagged
from smp_motor_ident.model.measurement import ANGLE, Measurement

Place = Literal["voltage", "torque", "output", "current"]


@dataclass(frozen=True, eq=False)
class Motion:
    """The model's free run, at the sections of the input or at the samples."""

    share: Array  # position in the record, -1 to 1
    step: Array  # length of the section or sampling interval [s]
    # voltage, speed, angle, output: [V], [rad/s], [rad], what is measured
    voltage: Array
    speed: Array
    angle: Array
    output: Array
    drop: Array  # ``v - K w`` [V]: the winding's current by its resistance
    current: Array  # [A], empty where none is measured
    # top, fastest: largest voltage and speed
    top: float
    fastest: float
    gear: float  # motor revolutions a wheel revolution
    kind: Measurement  # what the output shows
    # resistance [ohm] and L/R [s], where the current is measured
    resistance: float = 0.0
    electric_lag: float = 0.0

    @cached_property
    def own_lag(self) -> float:
        """The motor's own lag [sections] from how its speed follows its voltage."""
        speed, voltage = self.speed / self.fastest, self.voltage / self.top
        way = max(float(np.abs(np.diff(speed)).sum()), 1e-9)
        return max(float(np.abs(voltage - speed).sum() / way), 1.0)


@dataclass(frozen=True)
class Effect:
    """One explanation of what a model leaves over."""

    code: str
    place: Place
    cause: str
    advice: str
    regressors: Callable[[Motion], list[Array]]
    bends: bool = False  # whether it bends the line of steady speeds over voltages a little


def _sign(x: Array) -> Array:
    return np.asarray(np.sign(x))


def _change(m: Motion) -> Array:
    return np.diff(m.voltage, prepend=m.voltage[0])


def slope(values: Array, step: Array) -> Array:
    """Return the slope of what is given at the ends of intervals of these lengths [s]."""
    out = np.zeros(values.size)
    out[1:-1] = (values[2:] - values[:-2]) / np.maximum(step[1:-1] + step[2:], 1e-12)
    return out


def _late(values: Array, step: Array) -> list[Array]:
    first = slope(values, step)
    return [first, slope(first, step)]


def _once_a_turn(m: Motion, gear: float = 1.0) -> list[Array]:
    """Return what repeats with every turn of a shaft that has turned once at least."""
    if m.kind != ANGLE or np.ptp(m.angle) < 2 * np.pi * gear:
        return []
    return [np.sin(m.angle / gear), np.cos(m.angle / gear)]


def _weight(m: Motion) -> list[Array]:
    """Return what a weight on an output shaft does that swings by less than a turn."""
    angle = m.angle / m.gear
    if m.kind != ANGLE or not SWING.value < np.ptp(angle) < 2 * np.pi:
        return []
    return [np.sin(angle), np.cos(angle)]


def _missed(m: Motion) -> list[Array]:
    if m.kind != ANGLE:
        return []
    fast = m.speed * np.maximum(np.abs(m.speed) / m.fastest - 0.5, 0)
    return [np.cumsum(m.speed * np.abs(m.speed) * m.step), np.cumsum(fast * m.step)]


def _held_back(m: Motion) -> list[Array]:
    """A bridge that coasts: with a command of zero, or where the current would run back."""
    off = np.abs(m.voltage) < 0.01 * m.top
    back = (m.voltage * m.drop < 0) & ~off
    return [np.where(off, m.speed, 0.0), np.where(back, m.drop, 0.0)]


EFFECTS = (
    Effect(
        "dead_zone", "voltage", "a dead zone of the driver",
        "record the voltage at the motor's terminals, or declare it with --fix dead_zone=",
        lambda m: [_sign(m.voltage)],
    ),
    Effect(
        "clip", "voltage", "a command that is clipped at the supply",
        "stay below the supply's voltage, or declare it with --fix clip_voltage=",
        lambda m: [_sign(m.voltage) * np.maximum(np.abs(m.voltage) - c * m.top, 0.0)
                   for c in (0.65, 0.85)],
    ),
    Effect(
        "coast", "voltage", "a driver that lets the motor coast (fast decay)",
        "set the driver to brake (slow decay), or record the voltage at the terminals",
        _held_back,
    ),
    Effect(
        "supply_sag", "voltage", "a supply that sags under load",
        "record the supply's voltage, or the voltage at the terminals",
        lambda m: [m.drop * (m.voltage / m.top) ** 2, np.abs(m.voltage / m.top) * m.drop],
        bends=True,
    ),
    Effect(
        "supply_recovers", "voltage", "a supply that sags and recovers slowly",
        "record the supply's voltage, or the voltage at the terminals",
        lambda m: [m.voltage / m.top * _lagged(np.abs(m.voltage * m.drop) / m.top, m, c)
                   for c in (10.0, 100.0)],
    ),
    Effect(
        "brush_drop", "voltage", "a voltage drop over brushes or transistors",
        "record the voltage at the terminals; drive slowly through zero",
        lambda m: [np.tanh(20 * m.drop / m.top)],
    ),
    Effect(
        "current_limit", "voltage", "a driver that limits the current",
        "raise the limit, record smaller steps of voltage, or the voltage at the terminals",
        lambda m: [_sign(m.drop) * np.maximum(np.abs(m.drop) - c * m.top, 0.0)
                   for c in (0.3, 0.6, 1.0)],
    ),
    Effect(
        "saturation", "voltage", "a field that weakens with the current",
        "record with smaller steps of voltage",
        lambda m: [np.abs(m.drop) * m.speed, np.abs(m.drop) * m.drop], bends=True,
    ),
    Effect(
        "asymmetry", "voltage", "a motor or driver that differs between the directions",
        "estimate each direction by itself, from a record of one direction",
        lambda m: [np.ones(m.speed.size), np.abs(m.speed), np.abs(m.voltage)],
    ),
    Effect(
        "drag", "torque", "a drag that grows with the square of the speed",
        "record at the speeds at which the motor will run",
        lambda m: [m.speed * np.abs(m.speed)], bends=True,
    ),
    Effect(
        "stribeck", "torque", "friction that falls with speed (Stribeck)",
        "record less of the slowest speeds, or slow ramps through zero to see it",
        lambda m: [_sign(m.speed) * np.exp(-np.abs(m.speed) / (c * m.fastest))
                   for c in (0.03, 0.15)],
    ),
    Effect(
        "drift", "voltage", "a motor or supply that changed during the record",
        "record after warming up, and shorter; or state the two halves apart",
        lambda m: [m.share * m.voltage, m.share * m.speed],
    ),
    Effect(
        "drift", "torque", "a friction or load that changed during the record",
        "record after warming up, and shorter; or state the two halves apart",
        lambda m: [m.share * _sign(m.speed), m.share],
    ),
    Effect(
        "position", "torque", "a torque that depends on the angle (cogging, an unbalanced wheel)",
        "lift the wheel, or record at higher speed and for more turns",
        lambda m: _once_a_turn(m) + (_once_a_turn(m, m.gear) if m.gear > 1.5 else []),
    ),
    Effect(
        "gravity", "torque", "a weight that the motor lifts (an arm)",
        "take the weight off, or balance it, while recording",
        _weight,
    ),
    Effect(
        "dynamics", "voltage", "linear dynamics that the model lacks (compliance, a filter)",
        "sample faster; record the voltage at the terminals",
        lambda m: [_lagged(m.voltage, m, c) for c in (0.3, 3.0)],
    ),
    Effect(
        "slew", "voltage", "a driver that limits how fast the voltage rises",
        "switch the driver's ramp off, or declare it with --fix slew_rate=",
        lambda m: [_change(m) * np.abs(_change(m)), np.roll(_change(m), 1) * np.abs(_change(m))],
    ),
    Effect(
        "lag", "output", "a speed or angle that is filtered, or comes late",
        "declare the filter of the firmware, or record encoder counts with their stamps",
        lambda m: _late(m.output, m.step),
    ),
    Effect(
        "encoder_error", "output", "an encoder that is off once a turn",
        "centre the encoder's disc, or average over whole turns", _once_a_turn,
    ),
    Effect(
        "backlash", "output", "backlash between motor and encoder",
        "measure at the motor's shaft, or keep one direction under load",
        lambda m: [np.tanh(50 * m.speed / m.fastest)] if m.kind == ANGLE else [],
    ),
    Effect(
        "missed_counts", "output", "counts that are lost at speed",
        "let hardware count, or drive slower", _missed,
    ),
    Effect(
        "current_lag", "current", "a current that is filtered, averaged, or late",
        "declare the filter, or estimate without the current",
        lambda m: _late(m.current, m.step),
    ),
    Effect(
        "current_unsigned", "current", "a current without sign, or of another scale each way",
        "estimate without the current, or give it its sign",
        lambda m: [np.abs(m.current)],
    ),
    Effect(
        "current_of_supply", "current", "the supply's current in place of the motor's",
        "divide by the duty cycle, or estimate without the current",
        lambda m: [m.current * np.abs(m.voltage) / m.top],
    ),
    Effect(
        "current_offset", "current", "an offset of the current",
        "zero the current sensor at rest",
        lambda m: [np.ones(m.current.size)],
    ),
    Effect(
        "current_nonlinear", "current", "a current sensor that bends or clips",
        "widen the sensor's range",
        lambda m: [m.current * np.abs(m.current)],
    ),
)  # fmt: skip
"""Explanations in the order in which they are named where the data like them equally."""

FALLING_FRICTION = Effect(
    "stribeck", "torque", "friction that falls with speed (Stribeck)", "",
    lambda m: [np.where(m.speed == 0.0, _sign(m.voltage), _sign(m.speed))
               * np.exp(-np.square(m.speed / (c * m.fastest))) for c in (0.03, 0.1, 0.3)],
)  # fmt: skip
"""The same for a motor that sticks and breaks away, and of any shape that falls."""


def _lagged(signal: Array, m: Motion, factor: float) -> Array:
    """Return a signal through a first-order lag that is faster or slower than the motor's."""
    return lagged(signal, max(factor * m.own_lag, 0.3))
