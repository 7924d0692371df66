"""One wheel in open and closed loop without ROS, faster than real time.

Made of the parts that run on the robot: :class:`~smp_motor_control.motor.hardware.DrivenMotor`
is what ``motor_plant`` simulates, :class:`~smp_motor_control.wheel.loop.WheelLoop` what
``wheel_pid`` computes.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.file import MotorEntry
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings, Sample, Supply
from smp_motor_control.wheel.loop import LoopSettings, WheelLoop

Array = NDArray[np.float64]

__all__ = ["DriveSettings", "Run", "Supply", "Timing", "simulate_closed_loop", "simulate_open_loop"]


@dataclass(frozen=True, kw_only=True)
class Timing:
    """When samples are taken and commands arrive.

    Attributes
    ----------
    sample_time : float
        Interval between samples [s].
    delay : float
        From a sample to the arrival of the command that answers it [s].
    jitter : float
        Standard deviation of the intervals between samples [s].
    instants, delays : tuple of float
        In place of all that, what a recording shows: when samples were taken, and when they
        were answered [s]; NaN where one was not.
    """

    sample_time: float = 0.005
    delay: float = 0.0
    jitter: float = 0.0
    instants: tuple[float, ...] = ()
    delays: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 < self.sample_time < math.inf:
            raise ParameterError(f"sample_time is {self.sample_time!r} s; it must be positive")
        for name in ("delay", "jitter"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ParameterError(
                    f"{name} is {getattr(self, name)!r} s; it must be zero or positive"
                )


@dataclass(frozen=True, eq=False)
class Run:
    """Signals of one simulated wheel at its sampling instants, each of shape (n,).

    Attributes
    ----------
    time : ndarray
        [s].
    setpoint, reference, measurement : ndarray
        Of the loop [rad/s, wheel]; zero in open loop.
    velocity, position : ndarray
        True ones, of the wheel [rad/s], [rad].
    voltage : ndarray
        Mean over the interval that ends with the sample [V].
    command : ndarray
        Answer to the sample [V].
    current : ndarray
        As measured [A].
    count : ndarray of int64
        As the counter shows it.
    """

    time: Array
    setpoint: Array
    reference: Array
    measurement: Array
    velocity: Array
    position: Array
    voltage: Array
    command: Array
    current: Array
    count: NDArray[np.int64]


class _Tape:
    """Rows of a run while it is being made."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []

    def write(
        self, time: float, loop: tuple[float, float, float], plant: DrivenMotor, sample: Sample,
        command: float,
    ) -> None:  # fmt: skip
        gearbox, motor = plant.entry.gearbox, plant.motor
        truth = (gearbox.to_wheel(motor.speed), gearbox.to_wheel(motor.angle))
        self._rows.append(
            (time, *loop, *truth, sample.voltage, command, sample.current, sample.encoder_count)
        )

    def run(self) -> Run:
        columns = np.array(self._rows, dtype=np.float64).T
        named = dict(zip((f.name for f in fields(Run)), columns))
        counts = named.pop("count").astype(np.int64)
        return Run(count=counts, **named)


def _instants(duration: float, timing: Timing, seed: int) -> list[float]:
    if timing.instants:
        return list(timing.instants)
    draw = random.Random(seed)
    shortest = 0.1 * timing.sample_time
    time, instants = 0.0, [0.0]
    while time < duration - 0.5 * timing.sample_time:
        step = timing.sample_time
        if timing.jitter > 0:
            step = max(draw.gauss(step, timing.jitter), shortest)
        time = time + step if timing.jitter > 0 else len(instants) * timing.sample_time
        instants.append(time)
    return instants


def simulate_open_loop(
    entry: MotorEntry,
    voltage: Callable[[float], float],
    duration: float,
    *,
    timing: Timing | None = None,
    drive: DriveSettings | None = None,
    load: Callable[[float], float] | None = None,
    supply: Supply | None = None,
    seed: int = 0,
) -> Run:
    """Drive a motor with a voltage."""
    timing = timing or Timing()
    plant = DrivenMotor(entry, drive or _ideal(), supply, seed=seed)
    tape = _Tape()
    for time in _instants(duration, timing, seed):
        sample = plant.sample(time)
        command = voltage(time)
        tape.write(time, (0.0, 0.0, math.nan), plant, sample, command)
        _put_load(plant, time, load)
        plant.command(time + timing.delay, command)
    return tape.run()


def simulate_closed_loop(
    entry: MotorEntry,
    settings: LoopSettings,
    setpoint: Callable[[float], float],
    duration: float,
    *,
    timing: Timing | None = None,
    drive: DriveSettings | None = None,
    load: Callable[[float], float] | None = None,
    supply: Supply | None = None,
    seed: int = 0,
) -> Run:
    """Let a wheel's loop follow set-points."""
    timing = timing or Timing()
    plant = DrivenMotor(entry, drive or _ideal(), supply, seed=seed)
    loop = WheelLoop(
        settings.within(entry.supply_voltage),
        entry.gearbox,
        entry.encoder,
        1.5 * entry.supply_voltage,
    )
    tape = _Tape()
    before, command, arrival = None, 0.0, -math.inf
    instants = _instants(duration, timing, seed)
    delays = timing.delays or itertools.repeat(timing.delay, len(instants))
    for time, delay in zip(instants, delays, strict=True):
        sample = plant.sample(time)
        target, measurement = setpoint(time), math.nan
        answered = not math.isnan(delay)
        if answered and before is not None:
            dt = time - before
            measurement = loop.speed(dt, sample.velocity, sample.encoder_count, sample.voltage)
            known = not math.isnan(measurement)
            command = loop.step(target, measurement, dt).output if known else 0.0
        before = time if answered else before
        row = (target, loop.reference.velocity, measurement)
        tape.write(time, row, plant, sample, command)
        _put_load(plant, time, load)
        if answered:
            arrival = max(arrival, time + delay)
            plant.command(arrival, command)
    return tape.run()


def _ideal() -> DriveSettings:
    return DriveSettings(command_timeout=math.inf)


def _put_load(plant: DrivenMotor, time: float, load: Callable[[float], float] | None) -> None:
    if load is not None:
        plant.load(time, load(time))
