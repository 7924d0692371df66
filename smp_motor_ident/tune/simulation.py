# SPDX-License-Identifier: Apache-2.0
"""Simulate step and load responses of the loop, for a batch of motors at once.

The running PID (saturation, anti-windup, set-point weights, feed-forward) on the sampled
motor, all at the motor shaft.  Coulomb friction is a voltage whose sign is kept for a sample; it
holds a motor at rest under a smaller voltage.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array
from smp_motor_control.observer import DISTRUST_RATIO, INNOVATION_MEMORY_S
from smp_motor_ident._compile import compiled
from smp_motor_ident.chain.terminal import Driver, apply_driver, make_ideal_driver
from smp_motor_ident.limits import SETTLING_BAND
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.plant import NO_OBSERVER, SPEED, Plant

NO_EFFECT = make_ideal_driver()


@dataclass(frozen=True, eq=False)
class Controller:
    """A complete controller at the motor shaft."""

    feedback: Feedback  # gains that act on the measurement
    # weight, weight_d: Set-point weights of the proportional and the derivative action [-]
    weight: float = 1.0
    weight_d: float = 0.0
    limit: float = math.inf  # clamp of the output [V]
    tracking: float = math.inf  # time constant of back-calculation [s]; infinite switches it off


@dataclass(frozen=True, eq=False)
class Response:
    """Response of the loop; arrays of shape (n, k) at the sampling instants."""

    speed: Array  # shape (n, k), [rad/s]: true speed of the motor
    voltage: Array  # shape (n, k), [V]: output of the controller
    # shape (n,): whether the counts contradicted the observer, which the running loop then replaces
    contradicted: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Inputs:
    """Inputs of the loop at the sampling instants, each of shape (k,)."""

    # low, high: [rad/s]: without error between them; without ``high``, ``low`` is the reference
    low: Array
    high: Array | None = None
    forward: Array | float = 0.0  # [V]: Feed-forward
    load: Array | float = 0.0  # [V]: of a load, shape (k,) or (n, k)
    noise: Array | float = 0.0  # [rad/s]: on the measured speed, shape (n, k)
    angle_noise: Array | float = 0.0  # [rad]: on the angle that it is made from, shape (n, k)


def draw_white_noise(deviation: float, shape: tuple[int, int], seed: int = 0) -> Array:
    """Return reproducible white noise."""
    if deviation == 0.0:
        return np.zeros(shape)
    return np.asarray(deviation * np.random.default_rng(seed).standard_normal(shape))


def simulate(
    plant: Plant,
    controller: Controller,
    inputs: Inputs,
    *,
    count_angle: Array | float = 0.0,
    speed_step: float = 0.0,
    eccentric: Array | float = 0.0,
    friction: Array | None = None,
    modelled: float = 0.0,
    driver: Driver = NO_EFFECT,
) -> Response:
    """Run the closed loop from rest; ``modelled`` is the friction [V] that the observer knows.

    A speed is reported in steps of ``speed_step`` [rad/s]; ``eccentric`` [rad] is the amplitude of
    an encoder's error once a turn of the motor.
    The driver stands between the controller's output, which the observer knows, and the motor.
    """
    n, steps, fb = len(plant), inputs.low.size, controller.feedback
    numbers = (fb.p, fb.i, fb.d, fb.filter_time, controller.weight, controller.weight_d,
               controller.limit, 1.0 / controller.tracking)  # fmt: skip
    observer = plant.observer or NO_OBSERVER
    load, noise, of_angle = (
        np.broadcast_to(signal, (n, steps))
        for signal in (inputs.load, inputs.noise, inputs.angle_noise)
    )
    found = _run(
        (plant.phi, plant.taps, plant.phi_angle, plant.taps_angle), plant.sample_time, plant.sensor,
        plant.average,
        (observer.advance, observer.by_angle, observer.by_voltage, observer.taps),
        observer.variance,
        np.array(numbers, dtype=np.float64),
        np.asarray(inputs.low, dtype=np.float64),
        np.asarray(inputs.low if inputs.high is None else inputs.high, dtype=np.float64),
        np.ascontiguousarray(np.broadcast_to(inputs.forward, steps)), load,
        np.zeros(n) if friction is None else np.ascontiguousarray(friction),
        modelled, np.full(n, count_angle), speed_step, np.full(n, eccentric),
        np.ascontiguousarray(noise), np.ascontiguousarray(of_angle), driver.numbers, driver.lane,
        np.broadcast_to(plant.motors.a0, n),
    )  # fmt: skip
    return Response(*found)


@compiled
def _measure_turn(newest: float, oldest: float, count_angle: float) -> float:
    """Return the angle between two instants, in whole counts where there are counts."""
    if count_angle > 0.0:
        counts = math.floor(newest / count_angle) - math.floor(oldest / count_angle)
        return float(counts * count_angle)
    return newest - oldest


@compiled
def _average_speed(weights: Array, angle: Array, count_angle: float) -> float:
    """Return the weighted sum of the angles run through in the last steps."""
    total = 0.0
    for q in range(weights.size):
        total += weights[q] * _measure_turn(angle[q], angle[q + 1], count_angle)
    return total


@compiled
def _round_speed(speed: float, step: float) -> float:
    """Return a speed as it is reported."""
    return step * math.floor(speed / step + 0.5) if step > 0.0 else speed


@compiled
def _compute_drag(speed: float, friction: float, past: Array, reach: Array, load: float) -> float:
    """Return the voltage of dry friction over a sample [V]; at rest it balances the drive."""
    if speed != 0.0 or friction == 0.0:
        return float(friction * np.sign(speed))
    pushed = 0.0
    for q in range(past.size):
        if reach[q] != 0.0 and abs(past[q] - load) > abs(pushed):
            pushed = past[q] - load
    return float(min(max(pushed, -friction), friction))


@compiled
def _observe(
    advance: Array, by_angle: Array, by_voltage: Array, state: Array, swept: float, voltage: float
) -> Array:
    """Return the observer's state after a sample."""
    following = by_angle * swept + by_voltage * voltage
    for a in range(state.size):
        for b in range(state.size):
            following[a] += advance[a, b] * state[b]
    return following


@compiled
def _run(
    plant: tuple[Array, Array, Array, Array],
    T: float,
    sensor: int,
    average: Array,
    filtered: tuple[Array, Array, Array, Array],
    variance: float,
    controller: Array,
    low: Array,
    high: Array,
    forward: Array,
    load: Array,
    friction: Array,
    modelled: float,
    count_angles: Array,
    speed_step: float,
    eccentrics: Array,
    noise: Array,
    angle_noise: Array,
    driver: Array,
    lane: Array,
    back_emf: Array,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    phi, taps, phi_angle, taps_angle = plant
    advance, by_angle, by_voltage, observer_taps = filtered
    n, m, s = taps.shape
    steps, window = low.size, average.shape[1]
    speed, voltage = np.empty((n, steps)), np.empty((n, steps))
    p, i, d, filter_time, weight, weight_d, limit, back = controller
    contradicted, memory = np.zeros(n, dtype=np.bool_), min(T / INNOVATION_MEMORY_S, 1.0)
    for j in range(n):
        count_angle, eccentric = count_angles[j], eccentrics[j]
        x, following, past, given_out = np.zeros(s), np.zeros(s), np.zeros(m), np.zeros(m)
        angle = np.full(window + 1, count_angle * ((0.5 + 0.618034 * j) % 1.0))
        observer, place = np.zeros(by_angle.size), angle[0]
        integral = previous = rate = last = surprise = 0.0
        for k in range(steps):
            measured = observer[SPEED] if observer.size else x[sensor]
            if window > 0:
                measured = _average_speed(average[j], angle, count_angle)
            measured = _round_speed(measured + noise[j, k], speed_step)
            reference = min(max(measured, low[k]), high[k])
            slope = weight_d * reference - measured
            rate = (filter_time * rate + slope - previous) / (filter_time + T)
            previous = slope
            wanted = p * (weight * reference - measured) + integral + d * rate
            wanted += forward[k]
            given = min(max(wanted, -limit), limit)
            # Without an error nothing is integrated, nor taken back.
            change = i * (reference - measured) + (given - wanted) * back
            integral += T * change * (reference != measured)
            speed[j, k], voltage[j, k] = x[0], given
            for q in range(m - 1, 0, -1):
                past[q], given_out[q] = past[q - 1], given_out[q - 1]
            past[0] = given
            given_out[0], last = apply_driver(driver, lane, given, back_emf[j] * x[0], last, T)
            drag = _compute_drag(x[0], friction[j], given_out, taps_angle[j], load[j, k])
            swept = 0.0
            following[:] = 0.0
            for a in range(s):
                swept += phi_angle[j, a] * x[a]
                for b in range(s):
                    following[a] += phi[j, a, b] * x[b]
            # Load and friction act at once, the controller's voltage after its delay.
            for q in range(m):
                volts = given_out[q] - load[j, k] - drag
                swept += taps_angle[j, q] * volts
                for a in range(s):
                    following[a] += taps[j, q, a] * volts
            if friction[j] > 0.0 and (following[0] * x[0] < 0.0 or following[0] * drag < 0.0):
                following[:2], swept = 0.0, 0.0
            for q in range(window, 0, -1):
                angle[q] = angle[q - 1]
            before = angle[0]
            place += swept
            angle[0] = place + angle_noise[j, k] + eccentric * math.sin(place + j)
            if observer.size:
                swept = _measure_turn(angle[0], before, count_angle)
                delayed = np.sum(observer_taps * past[: observer_taps.size])
                delayed -= modelled * np.sign(observer[SPEED])
                observer[:] = _observe(advance, by_angle, by_voltage, observer, swept, delayed)
                innovation = observer[0] / by_angle[0]
                surprise += memory * (innovation * innovation / variance - surprise)
                contradicted[j] |= surprise > DISTRUST_RATIO
            x[:] = following
    return speed, voltage, contradicted


@dataclass(frozen=True)
class StepFigures:
    """Figures of a step response."""

    rise: float  # from 10 to 90 % [s]
    settling: float  # until it stays within 2 % [s]; NaN where it does not
    overshoot: float  # beyond the final value [%]
    peak_voltage: float  # largest magnitude [V]


def find_last_exit(time: Array, outside: NDArray[np.bool_]) -> Array:
    """Return the time from which signals, shape (..., k), stay in their band; NaN if they leave."""
    inside = np.argmax(outside[..., ::-1], axis=-1)
    begin = np.where(outside.any(axis=-1), time.size - inside, 0)
    return np.asarray(np.append(time, math.nan)[begin], dtype=np.float64)


def settling_time(time: Array, answer: Array, tolerance: float = SETTLING_BAND) -> float:
    """Return when the answer to a unit change stays within a tolerance of 1; NaN where never."""
    return float(find_last_exit(time, np.abs(answer - 1.0) > tolerance))


def step_figures(time: Array, speed: Array, voltage: Array, final: float) -> StepFigures:
    """Read a step response."""
    relative = speed / final
    low, high = np.argmax(relative >= 0.1), np.argmax(relative >= 0.9)
    rose = bool(np.any(relative >= 0.9))
    return StepFigures(
        rise=float(time[high] - time[low]) if rose else math.nan,
        settling=settling_time(time, relative),
        overshoot=float(max(100 * (relative.max() - 1), 0.0)),
        peak_voltage=float(np.abs(voltage).max()),
    )
