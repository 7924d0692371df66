# SPDX-License-Identifier: Apache-2.0
"""tune --relay: gains of one running wheel from a bounded oscillation, without a model.

A relay in place of the controller makes the loop oscillate at a bounded voltage.  The
fundamental of the recorded signals, ``|U1|^2 / |Y1 U1*|`` over every two cycles (P. Welch, The
use of fast Fourier transform for the estimation of power spectra, 1967), gives the ultimate gain
by the describing function; the ultimate period is that of the oscillation.

References
----------
.. [1] K. J. Astrom, T. Hagglund, Automatic tuning of simple regulators with specifications on
   phase and amplitude margins, Automatica 20 (1984), 645-651.
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.arrays import Array
from smp_motor_control.parameter_file import format_parameters
from smp_motor_ident.cli.processes import connect
from smp_motor_ident.errors import DesignError, ParameterError
from smp_motor_ident.report.document import check_free, write_together
from smp_motor_ident.tune.methods.rules import apply_rule

BIAS_SHARE = 0.4
"""Share of the supply around which the relay switches, so that friction is not crossed."""
MAX_GAP_SHARE = 0.25  # share of a cycle without a sample from which a recording is split
SIGNALS = ("time", "voltage", "applied", "speed", "angle")


def tune_by_relay(arguments: argparse.Namespace, files: Sequence[Path]) -> int:
    """Make a wheel run_relay_test and write the gains that follow."""
    supply, wheel = arguments.supply, arguments.relay
    if supply is None or not 0 < supply < math.inf:
        raise ParameterError("--relay needs the supply voltage; give --supply")
    amplitude = 0.25 * supply if arguments.relay_amplitude is None else arguments.relay_amplitude
    bias = BIAS_SHARE * supply
    if not 0 < amplitude <= supply - bias:
        raise ParameterError(
            f"--relay-amplitude is {amplitude:g} V; it must be within {supply - bias:g} V around "
            f"a bias of {bias:g} V"
        )
    check_free(files, arguments.force)
    print(
        f"{wheel} turns at {bias:g} V, then switches by {amplitude:g} V around it for "
        f"{arguments.relay_seconds:g} s",
        flush=True,
    )
    with connect("tune", arguments.ros_arguments) as robot:
        from smp_motor_control.nodes.wheel_test import Relay, run_relay_test

        relay = Relay(bias, amplitude, arguments.relay_hysteresis)
        seen = run_relay_test(robot, wheel, relay, arguments.relay_seconds)
    gain, period = read_oscillation(*resample_evenly(seen))
    rule, structure = arguments.rule or "tyreus_luyben", arguments.structure or "pi"
    ruled = apply_rule(rule, structure, gain, period)
    line = (
        f"{wheel}: ultimate gain {gain:.4g} V s/rad (wheel), period {1e3 * period:.3g} ms; {rule}: "
        f"p {ruled.p:.4g}, i {ruled.i:.4g}, d {ruled.d:.4g}"
    )
    print(line)
    if files:
        parameters = {
            "p": ruled.p, "i": ruled.i, "d": ruled.d,
            "derivative_filter_time_constant": ruled.filter_time,
            "u_clamp_min": -float(supply), "u_clamp_max": float(supply),
            "antiwindup_strategy": "back_calculation",
        }  # fmt: skip
        head = [f"Tuned by relay feedback. {line}"]
        text = format_parameters({f"/**/{wheel}/wheel_pid": parameters}, head)
        write_together({files[0]: text}, arguments.force)
        print(f"written: {files[0]}")
    return 0


def resample_evenly(answer: Mapping[str, Any]) -> tuple[list[tuple[Array, Array]], float]:
    """Return a recorded oscillation on even grids, cut where too many samples were lost."""
    time = np.array(answer["time"])
    if time.size < 20:
        raise DesignError(
            f"only {time.size} samples came while the relay switched, and 20 are needed; raise the "
            "rate of motor_state, or --relay-seconds"
        )
    step = float(np.median(np.diff(time)))
    rising = np.flatnonzero(np.diff(np.sign(answer["voltage"])) > 0)
    cycle = float(np.median(np.diff(time[rising]))) if rising.size > 1 else np.inf
    cuts = np.flatnonzero(np.diff(time) > max(MAX_GAP_SHARE * cycle, 3 * step)) + 1
    parts = [np.split(np.array(answer[name]), cuts) for name in SIGNALS]
    return [_even(step, *part) for part in zip(*parts, strict=True) if part[0].size > 2], step


def _even(
    step: float, time: Array, voltage: Array, applied: Array, speed: Array, angle: Array
) -> tuple[Array, Array]:
    """Return voltage and speed of one stretch as means over the intervals of an even grid."""
    lasted = np.diff(time)
    grid = np.arange(time[0], time[-1], step)
    if not np.isfinite(applied).all():  # the hardware does not report it
        applied = voltage
    # Means over intervals, long and short, are exact as integrals at their ends.
    volt_seconds = np.concatenate([[0.0], np.cumsum(applied[1:] * lasted)])
    if not np.isfinite(angle).all():
        angle = np.concatenate([[0.0], np.cumsum(speed[1:] * lasted)])
    even, turned = (np.diff(np.interp(grid, time, x)) / step for x in (volt_seconds, angle))
    return even, turned


MIN_CYCLES = 4
CYCLE_TOLERANCE = 0.25  # relative tolerance for the length of a cycle

TRANSIENT_CYCLES = 5  # cycles after which an oscillation is steady, where as many are there


def read_oscillation(
    stretches: Sequence[tuple[Array, Array]], sample_time: float
) -> tuple[float, float]:
    """Return ultimate gain and period of a relay oscillation, by stretches of voltage and speed."""
    switches = [_find_switches(voltage) for voltage, _ in stretches]
    lengths = np.concatenate([[], *map(np.diff, switches)])
    if lengths.size < MIN_CYCLES:
        raise DesignError(
            f"the relay switched over only {lengths.size} steady cycles, it needs "
            f"{MIN_CYCLES}; run it longer or with a larger amplitude"
        )
    # Skip cycles in which the computer paused or quantisation switched the relay twice.
    usual = float(np.median(lengths))
    alike = lengths[np.abs(lengths - usual) <= CYCLE_TOLERANCE * usual]
    power, cross = 0.0, 0j
    for begins, signals in zip(switches, stretches, strict=True):
        steady = np.abs(np.diff(begins) - usual) <= CYCLE_TOLERANCE * usual
        for k in np.flatnonzero(steady[:-1] & steady[1:]):
            sent, answered = (_compute_fundamental(x[begins[k] : begins[k + 2]]) for x in signals)
            power += abs(sent) ** 2
            cross += answered * sent.conjugate()
    if alike.size < MIN_CYCLES or power == 0:
        raise DesignError(
            f"only {alike.size} of {lengths.size} cycles are alike, it needs {MIN_CYCLES}: the "
            "delay varies; run it on a less busy machine"
        )
    if not abs(cross) > 0:
        raise DesignError("the wheel did not move under the relay; use a larger amplitude")
    return power / abs(cross), float(alike.mean()) * sample_time


def _find_switches(voltage: Array) -> NDArray[np.int64]:
    """Return the samples at which a relay switches up, without those of the transient."""
    switches = np.flatnonzero((voltage[:-1] <= 0) & (voltage[1:] > 0)) + 1
    return switches[min(switches.size // 3, TRANSIENT_CYCLES) :]


def _compute_fundamental(two_cycles: Array) -> complex:
    """Return the component of a period of half the length; the window has no mean or harmonics."""
    n = two_cycles.size
    time = np.arange(n)
    window = np.sin(np.pi * (time + 0.5) / n) ** 2
    return complex(np.sum(window * np.exp(-4j * np.pi * time / n) * two_cycles))
