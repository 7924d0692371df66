# SPDX-License-Identifier: Apache-2.0
"""Relay feedback: the ultimate point from a bounded oscillation, no model needed.

A relay in place of the controller makes the loop oscillate at a bounded voltage.  The
fundamental of the recorded signals, ``|U1|^2 / |Y1 U1*|`` over every two cycles (P. Welch, The
use of fast Fourier transform for the estimation of power spectra, 1967), gives the ultimate gain
by the describing function; the ultimate period is that of the oscillation.  The same evaluation
serves a simulated loop and a recording of a running wheel.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Automatic tuning of simple regulators with specifications on
   phase and amplitude margins, Automatica 20 (1984), 645-651.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array
from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.methods.rules import from_ultimate
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins

MIN_CYCLES = 4
CYCLE_TOLERANCE = 0.25  # relative tolerance for the length of a cycle

TRANSIENT_CYCLES = 5  # cycles after which an oscillation is steady, where as many are there


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


def read_oscillation(
    stretches: Sequence[tuple[Array, Array]], sample_time: float
) -> tuple[float, float]:
    """Return ultimate gain and period of a relay oscillation, by stretches of voltage and speed."""
    switches = [_settled(voltage) for voltage, _ in stretches]
    lengths = np.concatenate([[], *map(np.diff, switches)])
    if lengths.size < MIN_CYCLES:
        raise DesignError(
            f"the relay switched over only {lengths.size} steady cycles, it needs "
            f"{MIN_CYCLES}; run it longer or with a larger amplitude"
        )
    # Skip cycles during which the computer paused, or the relay switched twice on counts.
    usual = float(np.median(lengths))
    alike = lengths[np.abs(lengths - usual) <= CYCLE_TOLERANCE * usual]
    power, cross = 0.0, 0j
    for begins, signals in zip(switches, stretches, strict=True):
        steady = np.abs(np.diff(begins) - usual) <= CYCLE_TOLERANCE * usual
        for k in np.flatnonzero(steady[:-1] & steady[1:]):
            sent, answered = (_fundamental(x[begins[k] : begins[k + 2]]) for x in signals)
            power += abs(sent) ** 2
            cross += answered * sent.conjugate()
    if alike.size < MIN_CYCLES or power == 0:
        raise DesignError(
            f"only {alike.size} of {lengths.size} cycles are alike, it needs {MIN_CYCLES}: the "
            "delay varies; run it on a machine that is less busy"
        )
    if not abs(cross) > 0:
        raise DesignError("the wheel did not move under the relay; use a larger amplitude")
    return power / abs(cross), float(alike.mean()) * sample_time


def _settled(voltage: Array) -> NDArray[np.int64]:
    """Return the samples at which a relay switches up, without those of the transient."""
    switches = np.flatnonzero((voltage[:-1] <= 0) & (voltage[1:] > 0)) + 1
    return switches[min(switches.size // 3, TRANSIENT_CYCLES) :]


def _fundamental(two_cycles: Array) -> complex:
    """Return the component of a period of half the length; the window has no mean or harmonics."""
    n = two_cycles.size
    time = np.arange(n)
    window = np.sin(np.pi * (time + 0.5) / n) ** 2
    return complex(np.sum(window * np.exp(-4j * np.pi * time / n) * two_cycles))


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
    return from_ultimate(problem, rule, *read_oscillation([(voltage, speed)], loop.sample_time))


RELAY = Method(
    "relay",
    "Tyreus-Luyben from relay feedback",
    "Astrom and Hagglund 1984",
    RequiredMargins(phase=30.0, gain=2.0, sensitivity=2.2),
    _solve,
    ("relay_amplitude", "rule", "structure"),
)
