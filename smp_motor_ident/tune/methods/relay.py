# SPDX-License-Identifier: Apache-2.0
"""Measure the ultimate point by relay feedback: a bounded oscillation, without a model.

A relay in place of the controller makes the loop oscillate at a bounded voltage.  The
fundamental of the recorded signals, ``|U1|^2 / |Y1 U1*|`` over every two cycles (P. Welch, The
use of fast Fourier transform for the estimation of power spectra, 1967), gives the ultimate gain
by the describing function; the ultimate period is that of the oscillation.

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
