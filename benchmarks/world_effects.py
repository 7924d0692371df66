# SPDX-License-Identifier: Apache-2.0
"""Define the effects of real drives, each in three strengths.

An effect changes a `Case` before it is simulated.  ``causes`` are the codes of findings that
name it rightly; ``expect`` is "answer" where a right answer or a finding is due, "refuse" where
only a refusal is right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from world_signals import Motor


@dataclass
class Case:
    """One recording before it is made."""

    motor: Motor
    kind: str
    rate: float
    samples: int
    amplitude: float  # of the command [V]
    signals: str  # counts, counts_speed, speed or angle
    turn: float  # counts a motor revolution
    current: bool
    drive: dict[str, float] = field(default_factory=dict)
    sensor: dict[str, float] = field(default_factory=dict)
    stamps: dict[str, float] = field(default_factory=dict)
    widen: dict[str, tuple[float, float]] = field(default_factory=dict)  # truth as factors

    @property
    def step(self) -> float:
        return 1 / self.rate

    @property
    def tau(self) -> float:
        return self.motor.truth()["time_constant"]

    @property
    def stall(self) -> float:
        """Largest current [A]."""
        return self.amplitude / self.motor.R

    @property
    def fastest(self) -> float:
        return self.amplitude * self.motor.truth()["dc_gain"]


@dataclass(frozen=True)
class Effect:
    """One deviation of a drive from the plain motor."""

    name: str
    change: Callable[[Case, int], None]
    causes: tuple[str, ...] = ()
    expect: str = "answer"
    current: bool | None = None
    signals: tuple[str, ...] = ()


Scale = Callable[[Case], float] | None


def _drive(name: str, values: tuple[float, float, float], scale: Scale = None):
    def change(c: Case, level: int) -> None:
        c.drive[name] = values[level] * (scale(c) if scale else 1.0)

    return change


def _sensor(name: str, values: tuple[float, float, float], scale: Scale = None):
    def change(c: Case, level: int) -> None:
        c.sensor[name] = values[level] * (scale(c) if scale else 1.0)

    return change


def _stamps(name: str, values: tuple[float, float, float], scale: Scale = None):
    def change(c: Case, level: int) -> None:
        c.stamps[name] = values[level] * (scale(c) if scale else 1.0)

    return change


def _nothing(c: Case, level: int) -> None:
    pass


def _volts(c: Case) -> float:
    return c.amplitude


def _torque(c: Case) -> float:
    return c.motor.tc


def _stall_torque(c: Case) -> float:
    return c.motor.K * c.stall


def _tau(c: Case) -> float:
    return c.tau


def _step(c: Case) -> float:
    return c.step


def _dead_zone(c: Case, level: int) -> None:
    c.drive["dead_zone"] = (0.01, 0.03, 0.08)[level] * c.amplitude
    static = c.motor.truth()["static_voltage"]  # the two together are one at speed
    c.widen["static_voltage"] = (1.0, 1 + c.drive["dead_zone"] / static)


def _stribeck(c: Case, level: int) -> None:
    more = (0.2, 0.6, 1.5)[level]
    c.drive["stribeck"], c.drive["stribeck_speed"] = more, 0.06 * c.fastest
    c.widen["static_voltage"] = c.widen["coulomb_friction"] = (1.0, 1 + more)


def _weak(c: Case, level: int) -> None:
    c.drive["weak"] = share = (0.01, 0.04, 0.1)[level]
    c.widen["dc_gain"] = (1 - share, 1.0)


def _magnets(c: Case, level: int) -> None:
    a = (0.01, 0.03, 0.08)[level]
    c.drive["k_asym"] = a
    for name in ("dc_gain", "motor_constant"):
        c.widen[name] = (1 - a, 1 + a)
    for name in ("time_constant", "time_constant_product", "static_voltage"):
        c.widen[name] = (1 - 2 * a, 1 + 2 * a)


def _friction_sides(c: Case, level: int) -> None:
    a = (0.1, 0.3, 0.6)[level]
    c.drive["f_asym"] = a
    for name in ("static_voltage", "coulomb_friction"):
        c.widen[name] = (1 - a, 1 + a)


def _brushes(c: Case, level: int) -> None:
    c.drive["brush"] = (0.02, 0.05, 0.12)[level] * c.amplitude
    static = c.motor.truth()["static_voltage"]  # the two together are one at speed
    c.widen["static_voltage"] = (1.0, 1 + c.drive["brush"] / static)


def _declining(c: Case, level: int) -> None:
    """A motor that is driven at the end only shows the end's battery, whatever was at the start."""
    c.drive["decline"] = a = (0.01, 0.04, 0.1)[level]
    c.widen["dc_gain"] = (1 - a, 1.0)
    for name in ("static_voltage", "resistance", "inductance", "motor_constant", "inertia",
                 "viscous_friction", "coulomb_friction"):  # fmt: skip
        c.widen[name] = (1.0, 1 / (1 - a))


def _heating(c: Case, level: int) -> None:
    a = (0.02, 0.08, 0.2)[level]
    c.drive["r_drift"] = a
    t = c.motor.truth()
    hot = Motor(**{**vars(c.motor), "R": c.motor.R * (1 + a)}).truth()
    for name in ("dc_gain", "time_constant", "static_voltage", "resistance"):
        ends = sorted((1.0, hot[name] / t[name]))
        c.widen[name] = (ends[0], ends[1])


def _warming(c: Case, level: int) -> None:
    a = (0.1, 0.3, 0.6)[level]
    c.drive["f_drift"] = -a
    for name in ("static_voltage", "coulomb_friction"):
        c.widen[name] = (1 - a, 1.0)


def _ground(c: Case, level: int) -> None:
    more = (0.05, 0.15, 0.5)[level]  # rolling friction that wanders with the floor
    c.sensor["floor"] = more * c.motor.tc
    c.drive["load"] = 0.0


def _pwm(c: Case, level: int) -> None:
    c.drive["pwm"] = (8000.0, 2000.0, 490.0)[level]


def _compliance(c: Case, level: int) -> None:
    c.drive["two_mass"] = 1.0
    ring = (60.0, 20.0, 6.0)[level] / c.tau
    c.drive["share"] = 0.6
    c.drive["spring"] = ring**2 * c.motor.J * 0.6 * 0.4
    c.drive["damping"] = 0.1 * ring * c.motor.J * 0.6 * 0.4


def _backlash(c: Case, level: int) -> None:
    _compliance(c, 0)
    c.drive["damping"] *= 4
    c.drive["gap"] = (0.05, 0.2, 0.8)[level]


def _first_row(c: Case, level: int) -> None:
    c.kind = ("step", "square", "prbs")[level]
    c.stamps["first_row"] = 1.0


def _swapped(c: Case, level: int) -> None:
    c.sensor["sign"] = -1.0


def _standing(c: Case, level: int) -> None:
    if c.kind == "closed_loop":  # which drives as hard as it takes
        c.kind = "square"
    c.amplitude = (0.9, 0.6, 0.3)[level] * c.motor.truth()["static_voltage"]


def _rest(c: Case, level: int) -> None:
    c.stamps["rest"] = (2.0, 5.0, 10.0)[level]


LAGS = ("delay", "slew", "averaged_speed", "low_passed_speed", "lag_unknown")
CURRENT_LAGS = ("averaged_current", "low_passed_current", "smoothed_current")
SIDES = ("weak_side", "asymmetric_friction")
ONE_STEP = "one_size_of_step"  # which hides how slowly it lets it rise
ONE_SIZE = "one_size_of_voltage"  # which hides a driver's voltage drop
SPEED = ("speed",)
COUNTED = ("counts", "angle")
EFFECTS = (
    Effect("baseline", _nothing),
    Effect("dead zone", _dead_zone, ("dead_zone", "hard_dead_zone", ONE_SIZE)),
    Effect("driver offset", _drive("offset", (0.005, 0.015, 0.04), _volts),
           ("load", "one_direction")),
    Effect("supply sag", _drive("source", (0.05, 0.15, 0.4), lambda c: c.motor.R),
           ("supply_sag", ONE_SIZE)),
    Effect("battery declines", _declining, ("supply_drift", "friction_drift")),
    Effect("battery recovers", lambda c, n: c.drive.update(
        rc=(0.1, 0.3, 0.8)[n] * c.motor.R, rc_time=20 * c.tau),
        ("supply_sag", "supply_drift", ONE_SIZE)),
    Effect("clip at the supply", _drive("clip", (0.95, 0.85, 0.7), _volts), ("clip", ONE_SIZE)),
    Effect("coast in every PWM period", _pwm, ("coast", ONE_SIZE)),
    Effect("coast at zero command", _drive("coast_zero", (1.0, 1.0, 1.0)),
           ("coast_at_zero", "coast")),
    Effect("slew limit", lambda c, n: c.drive.update(
        slew=c.amplitude / ((0.3, 1.0, 3.0)[n] * c.tau)), (*LAGS, ONE_SIZE, ONE_STEP)),
    Effect("driver clock", _stamps("driver", (0.37, 0.83, 1.9), _step), LAGS),
    Effect("command delay", _stamps("delay", (0.5, 1.5, 4.2), _step), LAGS),
    Effect("two topics", _stamps("topics", (0.2, 0.6, 1.5), _step), LAGS),
    Effect("duty in few bits", _drive("levels", (127.0, 63.0, 31.0)),
           ("dead_zone", "hard_dead_zone")),
    Effect("weaker in reverse", _weak, SIDES),
    Effect("brush drop", _brushes, ("brush_drop", "dead_zone", ONE_SIZE)),
    Effect("jitter of stamps", _stamps("jitter", (0.1, 0.3, 0.6), _step), ()),
    Effect("exponential latency", _stamps("latency", (0.3, 1.0, 3.0), _step), ()),
    Effect("bursts", _stamps("bursts", (2.0, 4.0, 8.0)), ()),
    Effect("coarse stamps", _stamps("coarse", (0.3, 0.7, 1.0), _step), ()),
    Effect("gaps", _stamps("gaps", (1.0, 3.0, 8.0)), ()),
    Effect("rows lost", _stamps("lost", (0.005, 0.02, 0.1)), ()),
    Effect("first row is the step", _first_row),
    Effect("rest before", _rest),
    Effect("speed low-passed", _sensor("lowpass", (0.2, 1.0, 4.0), _tau), LAGS, signals=SPEED),
    Effect("speed averaged", _sensor("window", (2.0, 5.0, 16.0), _step), LAGS,
           signals=SPEED),
    Effect("speed coarse", _sensor("coarse", (0.01, 0.03, 0.1), lambda c: c.fastest),
           (), signals=SPEED),
    Effect("speed late", _sensor("late", (1.0, 2.0, 5.0), _step), LAGS, signals=SPEED),
    Effect("speed with outliers", _sensor("outliers", (0.001, 0.005, 0.02)), ("glitches",),
           signals=SPEED),
    Effect("once a turn", _sensor("eccentric", (0.003, 0.015, 0.06)), (),
           signals=COUNTED),
    Effect("missed counts", _sensor("missed", (0.003, 0.01, 0.03)), (),
           signals=("counts",)),
    Effect("backlash", _backlash, (), signals=COUNTED),
    Effect("compliance", _compliance, (), signals=COUNTED),
    Effect("current low-passed", _sensor("i_lowpass", (0.3, 1.0, 3.0), lambda c: max(
        c.step, c.motor.L / c.motor.R)), CURRENT_LAGS, current=True),
    Effect("current averaged", _sensor("i_window", (0.5, 1.0, 3.0), _step), CURRENT_LAGS,
           current=True),
    Effect("current scale", _sensor("i_scale", (0.02, 0.05, 0.15)), ("current_scale",),
           current=True),
    Effect("current offset", _sensor("i_offset", (0.005, 0.02, 0.08), lambda c: c.stall),
           ("current_offset",), current=True),
    Effect("current unsigned", _sensor("i_abs", (1.0, 1.0, 1.0)), ("current_unsigned",),
           current=True),
    Effect("current of the supply", _sensor("i_supply", (1.0, 1.0, 1.0)),
           ("current_of_supply", "current_scale"), current=True),
    Effect("current coarse", _sensor("i_coarse", (0.01, 0.04, 0.1), lambda c: c.stall),
           (), current=True),
    Effect("Stribeck", _stribeck, ("stribeck",)),
    Effect("magnets asymmetric", _magnets, SIDES),
    Effect("friction asymmetric", _friction_sides, SIDES),
    Effect("load per turn", _drive("turn_load", (0.2, 0.6, 1.5), _torque), ()),
    Effect("cogging", _drive("cog", (0.2, 0.6, 1.5), _torque), ()),
    Effect("drag", lambda c, n: c.drive.update(
        drag=(0.02, 0.08, 0.25)[n] * _stall_torque(c) / c.fastest**2), ("drag", ONE_SIZE)),
    Effect("constant load", _drive("load", (0.2, 0.6, 1.2), _torque),
           ("load", "one_direction")),
    Effect("load step", lambda c, n: c.drive.update(
        load_step=(0.2, 0.6, 1.2)[n] * c.motor.tc, load_time=0.55 * c.samples * c.step),
        ("load_step", "load")),
    Effect("winding heats", _heating, ("friction_drift", "supply_drift")),
    Effect("friction warms up", _warming, ("friction_drift",)),
    Effect("field weakens with current", _drive("k_sag", (0.02, 0.08, 0.2)), ()),
    Effect("wheel on the ground", _ground, ("load", "torque_noise")),
    Effect("blocked half-way", lambda c, n: c.drive.update(
        stall_time=(0.9, 0.7, 0.4)[n] * c.samples * c.step), ("load_step",), "refuse"),
    Effect("swapped sign", _swapped, (), "refuse"),
    Effect("standing motor", _standing, (), "refuse"),
    Effect("current smoothed", _sensor("i_smooth", (0.5, 2.0, 8.0)), CURRENT_LAGS,
           current=True),
    Effect("counts smoothed", _sensor("count_ema", (0.5, 0.25, 0.1)), LAGS,
           signals=SPEED),
)  # fmt: skip
