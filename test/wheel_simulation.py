# SPDX-License-Identifier: Apache-2.0
"""One wheel in open and closed loop without ROS, simulated with the robot's components."""

import math
import random
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings, Sample
from smp_motor_control.wheel.loop import WheelLoop

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Times of samples, and of their commands, which arrive ``delay`` later [s]."""

    sample_time: float = 0.005
    delay: float = 0.0
    jitter: float = 0.0  # standard deviation of the intervals


@dataclass(frozen=True, eq=False)
class Run:
    """Signals of one simulated wheel at its sampling instants, the true motion at the wheel.

    Set-point, reference and measurement are zero in open loop; the voltage is the mean over the
    interval that ends with the sample, the command its answer.
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


def _instants(duration: float, timing: Timing, seed: int) -> list[float]:
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


def simulate_open_loop(entry, voltage, duration, **world):
    """Drive a motor with a voltage."""
    nothing = 0.0, 0.0, math.nan
    return _simulate(entry, lambda time, dt, sample: (voltage(time), nothing), duration, **world)


def simulate_closed_loop(entry, settings, setpoint, duration, **world):
    """Let a wheel's loop follow set-points."""
    limit = 1.5 * entry.supply_voltage
    loop = WheelLoop(
        settings.clamp_to_supply(entry.supply_voltage), entry.gearbox, entry.encoder, limit
    )

    def answer(time: float, dt: float, sample: Sample) -> tuple[float, tuple[float, float, float]]:
        target, command, measurement = setpoint(time), 0.0, math.nan
        if dt > 0.0:
            measurement = loop.speed(dt, sample.velocity, sample.encoder_count, sample.voltage)
            if not math.isnan(measurement):
                command = loop.step(target, measurement, dt).output
        return command, (target, loop.reference.velocity, measurement)

    return _simulate(entry, answer, duration, **world)


def _simulate(entry, answer, duration, *, timing=None, drive=None, load=None, supply=None, seed=0):
    timing = timing or Timing()
    drive = drive or DriveSettings(command_timeout=math.inf)
    plant = DrivenMotor(entry, drive, supply, seed=seed)
    rows, before = [], 0.0
    for time in _instants(duration, timing, seed):
        sample = plant.sample(time)
        command, row = answer(time, time - before, sample)
        before = time
        truth = map(entry.gearbox.to_wheel, (plant.motor.speed, plant.motor.angle))
        rows.append(
            (time, *row, *truth, sample.voltage, command, sample.current, sample.encoder_count)
        )
        if load is not None:
            plant.load(time, load(time))
        plant.command(time + timing.delay, command)
    named = dict(zip((f.name for f in fields(Run)), np.array(rows, dtype=np.float64).T))
    return Run(**named | {"count": named["count"].astype(np.int64)})
