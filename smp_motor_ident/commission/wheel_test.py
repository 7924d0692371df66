# SPDX-License-Identifier: Apache-2.0
"""Evaluate a short wheel test: starting voltage, direction, speed and its uncertainty."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from smp_motor_control.arrays import Array, Flags
from smp_motor_ident.limits import (
    BREAKAWAY_COUNTS,
    MAX_FRICTION_SHARE,
    MAX_SUPPLY_SHORTFALL,
    MIN_RESPONSE_COUNTS,
)
from smp_motor_ident.record import Hardware

MIN_HOLD_S = 0.4  # shortest time for which a voltage is held [s]

ENCODER_DITHER = 1.0  # counts between which an encoder at rest on an edge toggles


@dataclass(frozen=True, eq=False)
class Trace:
    """Samples of one wheel during the test of all wheels; arrays of shape (n,)."""

    time: Array  # stamps [s]
    age: Array  # of the stamps on arrival [s]
    command: Array  # command when the sample was taken [V]
    voltage: Array  # as reported [V]
    velocity: Array  # of the wheel, as reported [rad/s]
    position: Array  # of the wheel, as reported [rad]
    count: Array  # total counts, or the motor's angle [rad] without an encoder
    phase: Array  # number of the phase

    @classmethod
    def of(cls, rows: ArrayLike) -> "Trace":
        """Return the trace of rows with these columns."""
        columns = np.asarray(rows, dtype=np.float64).reshape(-1, len(fields(cls))).T
        return cls(*columns)

    def during(self, *numbers: int) -> "Trace":
        """Return the part in some phases."""
        return self._take(np.isin(self.phase, numbers))

    def since(self, begin: int) -> "Trace":
        """Return the samples from an index on."""
        return self._take(slice(begin, None))

    def _take(self, kept: slice | Flags) -> "Trace":
        return Trace(*(getattr(self, f.name)[kept] for f in fields(self)))


@dataclass(frozen=True)
class Phase:
    """One part of the test of a wheel."""

    wheel: str  # the driven wheel
    number: int  # as in :class:`Trace`
    # zero voltage before; rising, constant and zero voltage
    kind: Literal["rest", "ramp", "hold", "coast"]
    level: float = 0.0  # voltage at the end, with its sign [V]


@dataclass(frozen=True)
class Figures:
    """Results of one wheel's test; NaN where unknown."""

    rate: float  # samples per second [Hz]
    age: float  # of the stamps on arrival, median [s]
    repeated: int  # stamps that do not grow
    at_rest: float  # turned under zero voltage [counts]
    breakaway: float  # command at which it began to turn, the larger of both directions [V]
    # 1 where positive commands make counts grow, -1 where they make them shrink, 0 where
    # nothing turned
    direction: float
    applied: float  # reported over commanded voltage
    velocity_ratio: float  # reported over counted speed of the wheel
    gain: float  # steady motor speed per volt beyond friction [rad/s/V]
    friction: float  # voltage that keeps it turning slowly [V]
    # coasting angle divided by the speed before it [s]: the time constant, reduced by friction
    coast: float
    level: float  # largest commanded voltage [V]


def responds_clearly(level: float, breakaway: float, counts: float) -> bool:
    """Return whether a wheel's response depends more on the motor than on friction."""
    return level * MAX_FRICTION_SHARE >= breakaway and counts >= MIN_RESPONSE_COUNTS


def has_settled(hold: Trace) -> bool:
    """Return whether a wheel turned as far in the last third of a held voltage as in the second.

    Thirds of the time of the reported voltage, because a busy computer takes samples in bunches.
    """
    there = _held(hold)
    time, count = there.time, there.count
    span = float(np.ptp(time)) if time.size > 8 else 0.0
    command, voltage = (float(np.median(x[-8:])) for x in (there.command, there.voltage))
    if span < MIN_HOLD_S or abs(voltage - command) > MAX_SUPPLY_SHORTFALL * abs(command):
        return False
    thirds = np.interp(time[0] + span * np.arange(1, 4) / 3, time, count)
    before, last = np.abs(np.diff(thirds))
    return bool(abs(before - last) <= max(0.02 * (before + last), 2.0))


def _held(hold: Trace) -> Trace:
    """Return the part after the last change of the reported voltage by more than a tenth."""
    end = float(np.median(hold.voltage[-8:])) if hold.time.size else 0.0
    other = np.flatnonzero(np.abs(hold.voltage - end) > 0.1 * abs(end))
    begin = int(other[-1]) + 1 if other.size else 0
    # With so much scatter no change can be detected.
    return hold if hold.time.size - begin < 8 else hold.since(begin)


def figures(trace: Trace, phases: Sequence[Phase], hardware: Hardware) -> Figures:
    """Evaluate the test of one wheel, by its speeds from counts in its own phases."""
    steps = np.diff(trace.time)
    holds = [trace.during(p.number) for p in phases if p.kind == "hold"]
    levels = [p.level for p in phases if p.kind == "hold"]
    steady = [_Steady.of(hold, hardware) for hold in holds]
    starts = [_breakaway(trace.during(p.number)) for p in phases if p.kind == "ramp"]
    rest = trace.during(*(p.number for p in phases if p.kind == "rest"))
    gain, friction = _line([s.voltage for s in steady], [s.speed for s in steady])
    applied: Iterable[float] = (s.voltage / level for s, level in zip(steady, levels))
    if not holds:  # it never turned
        ramps = trace.during(*(p.number for p in phases if p.kind == "ramp"))
        late = np.abs(ramps.command) > 0.5 * np.abs(ramps.command).max(initial=0.0)
        applied = ramps.voltage[late] / ramps.command[late]
    signs = [math.copysign(1.0, s.speed * level) for s, level in zip(steady, levels) if s.speed]
    return Figures(
        rate=1.0 / float(np.median(steps)) if steps.size and np.median(steps) > 0 else math.nan,
        age=float(np.median(trace.age)) if trace.age.size else math.nan,
        repeated=int((steps <= 0).sum()),
        at_rest=float(np.ptp(rest.count)) if rest.time.size else 0.0,
        breakaway=max(starts) if starts and np.all(np.isfinite(starts)) else math.nan,
        direction=float(np.sign(sum(signs))),
        applied=_median(applied),
        velocity_ratio=_median(s.reported / s.wheel for s in steady if s.wheel),
        gain=gain,
        friction=friction,
        coast=_median(
            _coast(trace.during(a.number), trace.during(b.number), hardware)
            for a, b in itertools.pairwise(phases)
            if a.kind == "hold" and b.kind == "coast"
        ),
        level=max(map(abs, levels), default=math.nan),
    )


def count_coupled_motion(
    traces: Mapping[str, Trace], phases: Sequence[Phase]
) -> dict[str, dict[str, float]]:
    """Return the counts that every wheel turned while one was driven, by driven wheel."""
    found: dict[str, dict[str, float]] = {}
    for driven in dict.fromkeys(p.wheel for p in phases):
        numbers = [p.number for p in phases if p.wheel == driven and p.kind in ("ramp", "hold")]
        parts = {wheel: trace.during(*numbers) for wheel, trace in traces.items()}
        found[driven] = {
            wheel: float(np.ptp(part.count)) if part.time.size else 0.0
            for wheel, part in parts.items()
        }
    return found


@dataclass(frozen=True)
class _Steady:
    """The second half of a constant voltage: voltage, motor speed, and the wheel's two speeds."""

    voltage: float
    speed: float
    wheel: float
    reported: float

    @classmethod
    def of(cls, hold: Trace, hardware: Hardware) -> "_Steady":
        hold = _held(hold)
        middle = 0.5 * (hold.time[0] + hold.time[-1]) if hold.time.size else 0.0
        late = hold.since(int(np.searchsorted(hold.time, middle)))
        if late.time.size < 2 or late.time[-1] <= late.time[0]:
            return cls(math.nan, 0.0, 0.0, math.nan)
        voltage, angle = float(late.voltage.mean()), late.count * _angle_per_count(hardware)
        if np.ptp(angle) < BREAKAWAY_COUNTS * _angle_per_count(hardware):
            return cls(voltage, 0.0, 0.0, math.nan)
        speed = float((angle[-1] - angle[0]) / np.ptp(late.time))
        return cls(voltage, speed, speed / hardware.gear_ratio, float(late.velocity.mean()))


def _angle_per_count(hardware: Hardware) -> float:
    return 2 * math.pi / (hardware.counts_per_revolution or 2 * math.pi)


def _breakaway(ramp: Trace) -> float:
    """Return the command at which a wheel started to turn steadily [V]; NaN if it did not."""
    if ramp.time.size < 2:
        return math.nan
    turned = np.abs(ramp.count - ramp.count[0])
    if turned[-1] < BREAKAWAY_COUNTS:
        return math.nan
    still = np.flatnonzero(turned <= ENCODER_DITHER)
    return float(abs(ramp.command[still[-1]]))


def _coast(hold: Trace, coast: Trace, hardware: Hardware) -> float:
    steady, free = _Steady.of(hold, hardware), _held(coast)
    if not steady.speed or free.time.size < 2:
        return math.nan
    if abs(float(np.median(free.voltage[-8:]))) > MAX_SUPPLY_SHORTFALL * abs(steady.voltage):
        return math.nan  # a busy computer has not yet released it
    angle = free.count * _angle_per_count(hardware)
    return float((angle[-1] - angle[0]) / steady.speed)


def _line(voltages: Sequence[float], speeds: Sequence[float]) -> tuple[float, float]:
    """Return gain and friction of ``|speed| = gain (|voltage| - friction)``."""
    volts, speed = np.abs(voltages), np.abs(speeds)
    turning = (speed > 0) & np.isfinite(volts)
    if turning.sum() < 2 or np.ptp(volts[turning]) < 0.1 * volts[turning].max():
        return math.nan, math.nan
    gain, offset = np.polyfit(volts[turning], speed[turning], 1)
    return (float(gain), float(-offset / gain)) if gain > 0 else (math.nan, math.nan)


def _median(values: Iterable[float]) -> float:
    known = [v for v in values if math.isfinite(v)]
    return float(np.median(known)) if known else math.nan
