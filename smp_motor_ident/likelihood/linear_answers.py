"""What voltages beside the input change in a motor that only slides.

Without events the answer to each is the motor's own response from rest; many are carried at once.
Derivation: docs/derivations.md, section 6.
"""

from __future__ import annotations

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled
from smp_motor_ident.likelihood.linear_pass import NUMBERS, TILE, fill, tabulate
from smp_motor_ident.likelihood.propagator import DECAYED


@compiled
def answers_sliding(
    time: Array,
    starts: Integers,
    output: Array,
    angle: bool,
    par: Array,
    usual: float,
    beside: Array,
    together: int,
    answers: Array,
) -> None:
    """Add up over rows of samples what voltages beside the input, one a row, change in the output.

    Each begins a segment without effect.
    """
    row, table = np.zeros(NUMBERS), tabulate(usual, par)
    step = -1.0
    e00 = e01 = e10 = e11 = h0 = h1 = v0 = v1 = v2 = 0.0
    x = np.zeros((3, beside.shape[0]))
    q, w, th = x[0], x[1], x[2]
    line = -1
    for g in range(starts.shape[0] - 1):
        first = starts[g]
        x[:] = 0.0
        for n in range(first, starts[g + 1]):
            if n > first:
                h = time[n] - time[n - 1]
                if abs(h - step) > 1e-9 * h + 1e-15 * abs(time[n]):
                    step = h
                    fill(row, h, par, table)
                    e00, e01, e10, e11, h0, h1 = row[0], row[1], row[2], row[3], row[4], row[5]
                    v0, v1, v2 = row[6], row[7], row[8]
                if n % TILE == 0:
                    for j in range(q.shape[0]):
                        if abs(q[j]) + abs(w[j]) < DECAYED:
                            q[j] = w[j] = 0.0
                for j in range(q.shape[0]):
                    v = beside[j, n]
                    th[j] += h0 * q[j] + h1 * w[j] + v2 * v
                    old = q[j]
                    q[j] = e00 * old + e01 * w[j] + v0 * v
                    w[j] = e10 * old + e11 * w[j] + v1 * v
            line += (n - first) % together == 0
            if output[n] == output[n]:
                for j in range(q.shape[0]):
                    answers[line, 0, j] += th[j] if angle else w[j]
