"""Fewer samples where a motor is sampled far faster than it moves, for the comparison of models.

Derivation: docs/derivations.md, section 10.
"""

from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.measurement import ANGLE

FINER = 8  # samples to keep in the longest interval over which the speed hardly changes
LEAST = 2_000  # samples of each segment, or so, that stay
MOST = 200_000  # samples looked at
JUMP = 0.02  # of the input's range: a change above it stays where it is
FEWEST = 4  # samples to one, below which thinning is not worth it


def thinned(data: Experiments) -> Experiments:
    """Return every k-th sample where there are far more than the motor's motion needs.

    The input keeps its jumps where they are; between them it is averaged.
    """
    if data.kind != ANGLE or data.current.size:
        return data
    k = min(_idle(data) // FINER, data.size // (LEAST * (len(data.starts) - 1)))
    return _every(data, k) if k >= FEWEST else data


def _idle(data: Experiments) -> int:
    """Return over how many samples a mean speed still shows the whole motion."""
    y = data.output[np.isfinite(data.output)][:MOST]
    rough = float(np.diff(y, n=4).var()) / 70 if y.size > 8 else 0.0
    noise = 2 * max(rough, data.quantum**2 / 12)

    def motion(k: int) -> float:
        return float(np.var(y[k:] - y[:-k]) - noise) / k**2

    k = 1
    while 8 * k < y.size and noise / k**2 > 0.1 * motion(k):
        k *= 2
    while 8 * k < y.size and motion(2 * k) > 0.98 * motion(k):
        k *= 2
    return k


def _every(data: Experiments, k: int) -> Experiments:
    keep: list[Integers] = []
    ends: list[Array] = []
    values: list[Array] = []
    starts, first = [0], []
    largest = JUMP * float(np.ptp(data.hold_value))
    for g, (a, b) in enumerate(zip(data.starts[:-1], data.starts[1:], strict=True)):
        samples = np.arange(a, b, k)
        keep.append(samples)
        starts.append(starts[-1] + len(samples))
        begin = int(data.hold_start[g])
        last = len(data.hold_end) if g + 2 == len(data.starts) else data.hold_start[g + 1]
        end, value = _merged(data, begin, int(last), data.time[samples], largest)
        first.append(sum(len(e) for e in ends))
        ends.append(end)
        values.append(value)
    index = np.concatenate(keep)
    return replace(
        data,
        time=data.time[index],
        output=data.output[index],
        starts=np.array(starts, dtype=np.int64),
        hold_end=np.concatenate(ends),
        hold_value=np.concatenate(values),
        hold_start=np.array(first, dtype=np.int64),
        step=data.step * k,
    )


def _merged(
    data: Experiments, begin: int, last: int, time: Array, largest: float
) -> tuple[Array, Array]:
    """Return a segment's input, constant between samples and jumps."""
    end, value = data.hold_end[begin:last], data.hold_value[begin:last]
    jumps = end[:-1][np.abs(np.diff(value)) > largest]
    inside = jumps[(jumps > time[0]) & (jumps < time[-1])]
    edges = np.union1d(time, inside)
    charge = np.concatenate([[0.0], np.cumsum(value[1:] * np.diff(end))])
    mean = np.diff(np.interp(edges, end, charge)) / np.diff(edges)
    return edges, np.concatenate([value[:1], mean])
