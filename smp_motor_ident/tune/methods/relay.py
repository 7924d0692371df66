"""Relay feedback: the ultimate point from a bounded oscillation, no model needed.

A relay in place of the controller makes the loop oscillate at a bounded voltage.  The
fundamental of what it did, ``|U1| / |Y1|``, is the describing function's answer for the
ultimate gain; the period is that of the oscillation.  The same reading serves an oscillation
of the simulated loop and one recorded on a running wheel.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Automatic tuning of simple regulators with specifications on
   phase and amplitude margins, Automatica 20 (1984), 645-651.
"""

from __future__ import annotations

import math

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.arrays import Array
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.methods.ziegler_nichols import from_ultimate
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins

LEAST_CYCLES = 4
ALIKE = 0.25
"""Share by which the length of a cycle may differ from the usual one and still count."""

BAND = 0.1
"""Share of the frequency on either side of it that counts as the oscillation's."""


def oscillate(
    problem: Problem, amplitude: float, hysteresis: float, seconds: float
) -> tuple[Array, Array]:
    """Run the sampled loop with a relay in place of the controller."""
    plant, count = problem.plant, problem.loop.count_angle
    T, window = plant.sample_time, plant.window
    steps = int(seconds / T)
    phi, taps = plant.phi[0], plant.taps[0]
    phi_angle, taps_angle = plant.phi_angle[0], plant.taps_angle[0]
    average = plant.average[0]
    x, past = np.zeros(phi.shape[0]), np.zeros(taps.shape[0])
    angle = np.zeros(window + 1)
    voltage, speed = np.empty(steps), np.empty(steps)
    output = amplitude
    for k in range(steps):
        if window:
            counted = np.floor(angle / count) * count if count else angle
            measured = -np.diff(counted) @ average
        else:
            measured = x[plant.sensor]
        if measured > hysteresis:
            output = -amplitude
        elif measured < -hysteresis:
            output = amplitude
        past[1:], past[0] = past[:-1].copy(), output
        angle[1:], angle[0] = angle[:-1].copy(), angle[0] + phi_angle @ x + taps_angle @ past
        x = phi @ x + past @ taps
        voltage[k], speed[k] = output, measured
    return voltage, speed


def read_oscillation(voltage: Array, speed: Array, sample_time: float) -> tuple[float, float]:
    """Return ultimate gain and period of a recorded relay oscillation."""
    switches = np.flatnonzero((voltage[:-1] <= 0) & (voltage[1:] > 0)) + 1
    # The first half of the cycles is the transient.
    switches = switches[switches.size // 2 :]
    if switches.size <= LEAST_CYCLES:
        raise DesignError(
            f"the relay switched over only {max(switches.size - 1, 0)} steady cycles, it needs "
            f"{LEAST_CYCLES}; run it longer or with a larger amplitude"
        )
    lengths = np.diff(switches)
    # A cycle during which the machine stood still, or counts made it switch twice, is none.
    alike = np.flatnonzero(np.abs(lengths - np.median(lengths)) <= ALIKE * np.median(lengths))
    if alike.size < LEAST_CYCLES:
        raise DesignError(
            f"only {alike.size} of {lengths.size} cycles are alike, it needs {LEAST_CYCLES}: the "
            "delay wanders; run it on a machine that is less busy"
        )
    period = float(lengths[alike].mean())
    sent, answered = _fundamentals(voltage[switches[0] :], speed[switches[0] :], 1 / period)
    if not answered > 0:
        raise DesignError("the wheel did not move under the relay; use a larger amplitude")
    return sent / answered, period * sample_time


def _fundamentals(voltage: Array, speed: Array, frequency: float) -> tuple[float, float]:
    """Return the sizes of two signals around a frequency [per sample].

    What the motor makes of a voltage does not depend on whether that repeats exactly: a record
    whose cycles wander is as good, so long as it fades in and out.
    """
    time = np.arange(voltage.size)
    fade = np.sin(np.pi * (time + 0.5) / voltage.size) ** 2
    reach = max(BAND * frequency, 2 / voltage.size)
    around = np.linspace(frequency - reach, frequency + reach, 41)
    turns = np.exp(-2j * math.pi * np.outer(around, time)) * fade
    sent, answered = (turns @ (x - np.mean(x)) for x in (voltage, speed))
    return float(np.linalg.norm(sent)), float(np.linalg.norm(answered))


def _solve(problem: Problem) -> Feedback:
    loop = problem.loop
    amplitude = problem.target("relay_amplitude", 0.25 * loop.supply_voltage)
    if amplitude > loop.supply_voltage:
        raise DesignError(
            f"relay_amplitude is {amplitude:g} V, above the supply of {loop.supply_voltage:g} V"
        )
    window = problem.plant.window
    quantum = loop.count_angle / (window * loop.sample_time) if window else 0.0
    model = problem.reduced
    seconds = 40 * max(model.delay, 2 * loop.sample_time) + 10 * model.time_constant
    voltage, speed = oscillate(problem, amplitude, quantum, seconds)
    rule = str(problem.targets.get("rule") or "tyreus_luyben")
    if rule not in ("tyreus_luyben", "ziegler_nichols"):
        raise DesignError(f"rule is {rule!r}; it must be tyreus_luyben or ziegler_nichols")
    return from_ultimate(problem, rule, *read_oscillation(voltage, speed, loop.sample_time))


RELAY = Method(
    "relay",
    "Tyreus-Luyben from relay feedback",
    "Astrom and Hagglund 1984",
    RequiredMargins(phase=30.0, gain=2.0, sensitivity=2.2),
    _solve,
    ("relay_amplitude", "rule", "structure"),
)
