"""One pass over the data: which compiled loop, its memory, and the normal equations after it.

Derivation: docs/derivations.md, sections 6 to 8.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.likelihood import recursion
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.linear_answers import answers_sliding
from smp_motor_ident.likelihood.linear_pass import run_sliding, squares_sliding
from smp_motor_ident.likelihood.low_pass import LOW_PASS_WEIGHTS
from smp_motor_ident.likelihood.noise import NoiseModel, whitening
from smp_motor_ident.likelihood.normal_equations import eliminate
from smp_motor_ident.likelihood.sensitivities import LANES
from smp_motor_ident.model.columns import CURRENT_LAG, WINDOW
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.measurement import ANGLE, LATE_SPEED, MEAN_SPEED, SPEED
from smp_motor_ident.model.structures import SENSORS, Structure, sensor_of

LEAST_LAG = 1e-3  # of a sample: of a sensor that shows the current as good as at once
NEAR = np.array([1e-2, 1e-2, 1e-2, 0.0, 1e-2])
"""Of a sample's information, by which each of (q, w, angle, load, earlier current) stays where it
began: not a load, which friction would then be known by where both are one sum."""
BLOCKS = 60  # runs of samples whose scores are summed, for the covariance of coloured residuals


@dataclass(frozen=True, eq=False)
class Sums:
    """What the loop over the samples gathered."""

    # normal, gradient, cost: shapes (g, p, p), (g, p), (g,): of each segment; the common columns
    # before its own
    normal: Array
    gradient: Array
    cost: Array
    spread: Array  # shape (6,): sums of squares and product of the raw residuals, and their numbers
    # scores, owner: shapes (blocks, p) and (blocks,): scores summed over runs of samples, and the
    # segments of these
    scores: Array
    owner: Integers


@dataclass(frozen=True, eq=False)
class Pass:
    """What one run over the data gave, the initial states eliminated."""

    objective: float  # weighted sum of squares
    # normal, gradient: shapes (f, f) and (f,): of the common columns
    normal: Array
    gradient: Array
    # local_step, local_gain: shapes (g, l) and (g, l, f): step of the own columns, and by how much
    # it is less per common step
    local_step: Array
    local_gain: Array
    local_decrease: float  # by how much the own steps alone lower the objective
    spread: Array  # shape (6,): as in `Sums`
    scores: Array  # shape (blocks, f): scores summed over runs of samples
    # What windings that could begin as they like cost in likelihood (Laplace's approximation)
    occam: float = 0.0

    def scaled(self, factor: float) -> Pass:
        """Return the same under residuals that weigh otherwise."""
        return replace(
            self,
            objective=self.objective * factor,
            local_decrease=self.local_decrease * factor,
            normal=self.normal * factor,
            gradient=self.gradient * factor,
            scores=self.scores * factor,
        )


@dataclass(frozen=True, eq=False)
class Beside:
    """Signals beside what was given, each of which the motor answers."""

    voltage: Array  # shape (r, sections): to the voltage of each section [V]; (0, 0) for none
    # shape (2, r, n): to what output and current show, which may correct the state; (0, 0, 0)
    added: Array
    # shape (rows, o, p + r): sums, over runs of samples, of what the own columns and the signals
    # change in output and current
    answers: Array
    together: int  # samples in a row, fewer at the end of a segment


NOTHING = Beside(np.zeros((0, 0)), np.zeros((0, 0, 0)), np.zeros((0, 0, 0)), 1)


def row_starts(data: Experiments, together: int) -> Integers:
    """Return where rows of so many samples begin, each in one segment."""
    parts = [np.arange(a, b, together) for a, b in itertools.pairwise(data.starts)]
    return np.concatenate(parts)


def answers(
    data: Experiments,
    structure: Structure,
    z: Coordinates,
    initial: Array,
    noise: NoiseModel,
    signals: tuple[Array, Array],
    together: int,
    own: bool,
) -> Array:
    """Return what own columns and signals (`Beside`) change in the predictions, summed by rows."""
    count = own * (structure.matrix.shape[1] + len(own_columns(data, structure)))
    width = count + max(signals[0].shape[0], signals[1].shape[1])
    sums = np.zeros((row_starts(data, together).size, 1 + (data.current.size > 0), width))
    if width == len(signals[0]) and not signals[1].size and _slides(data, structure, z, noise):
        answers_sliding(
            data.time, data.starts, data.output, data.kind == ANGLE, structure.internal(z)[0],
            data.jittered, signals[0], together, sums,
        )  # fmt: skip
        return sums
    beside = Beside(*signals, sums, together)
    gather(data, structure, z, initial, noise, differentiate=own, beside=beside)
    return sums


def own_columns(data: Experiments, structure: Structure) -> tuple[int, ...]:
    """Return which of (q, w, angle, load, earlier current) each segment has to itself.

    In the angle's place a low-passed speed has what it is ahead of the speed at first.
    """
    angle = (2,) if data.kind == ANGLE or data.kind.low_passed else ()
    own = (1,) if structure.order == 1 else (0, 1)
    earlier = (4,) if structure.lags else ()
    return own + angle + ((3,) if structure.own_load else ()) + earlier


def gather(
    data: Experiments,
    structure: Structure,
    z: Coordinates,
    initial: Array,
    noise: NoiseModel | None = None,
    predicted: Array | None = None,
    differentiate: bool = True,
    beside: Beside = NOTHING,
) -> Sums:
    """Run over the data once; scores are summed over `BLOCKS` runs of samples or so."""
    noise = NoiseModel() if noise is None else noise
    par, internal = structure.internal(z)
    # A motor drawn at random near another may have any lag: no sensor is early.
    par[CURRENT_LAG] = max(par[CURRENT_LAG], LEAST_LAG * data.step)
    slope = np.ascontiguousarray(internal @ structure.matrix) if differentiate else internal[:, :0]
    own = np.array(own_columns(data, structure) if differentiate else (), dtype=np.int64)
    p, segments = slope.shape[1] + own.size, len(data.starts) - 1
    length = max(1, -(-data.size // BLOCKS))
    rows = data.size // length + 2 * segments + 2
    scores, owner = np.empty((rows, p)), np.empty(rows, dtype=np.int64)
    normal, gradient, cost = np.empty((segments, p, p)), np.empty((segments, p)), np.zeros(segments)
    spread = np.zeros(6)
    angle = data.kind == ANGLE
    noted = np.zeros((0, 3)) if predicted is None else predicted
    alone = not (beside.voltage.size or beside.added.size) and (predicted is None or p == 0)
    if alone and beside.together == 1 and _slides(data, structure, z, noise):
        if p == 0:
            spread[0], spread[3] = squares_sliding(
                data.time, data.starts, data.hold_value, data.output, angle, par, initial,
                data.jittered, noted,
            )  # fmt: skip
            used = 0
        else:
            used = run_sliding(
                data.time, data.starts, data.hold_value, data.output, angle, par, slope,
                initial, own, data.jittered, 1 / math.sqrt(noise.covariance[0, 0]), normal,
                gradient, cost, spread, length, scores, owner, beside.answers,
            )  # fmt: skip
    else:
        used = recursion.run(
            data.time, data.starts, data.hold_end, data.hold_value, data.hold_start,
            data.output, data.current, data.kind.code, structure.friction != "none", par, slope,
            initial, own, noise.gain, whitening(noise.covariance), noise.huber, normal, gradient,
            cost, spread, length, scores, owner, _ring(data, par, max(p, beside.answers.shape[-1])),
            SENSORS.index(sensor_of(structure)), _trail(data, structure, par), data.step,
            noted, data.jittered, beside.voltage, beside.added, beside.answers, beside.together,
        )  # fmt: skip
    return Sums(normal, gradient, cost, spread, scores[:used], owner[:used])


def _ring(data: Experiments, par: Array, p: int) -> Array:
    """Return the memory for the filter of a speed."""
    if data.kind.low_passed:
        return np.zeros((2, max(4 + 3 * p, LOW_PASS_WEIGHTS)))
    if data.kind not in (MEAN_SPEED, LATE_SPEED):
        return np.zeros((0, 0))
    return np.zeros((_depth(data, par[WINDOW]), 3 + 2 * p))


def _trail(data: Experiments, structure: Structure, par: Array) -> Array:
    """Return the memory for the window of a mean current."""
    if sensor_of(structure) != "averaged":
        return np.zeros((0, 0))
    return np.zeros((_depth(data, 2 * par[CURRENT_LAG]), 2 + LANES))


def _depth(data: Experiments, width: float) -> int:
    """Return how many samples a window may hold."""
    steps = np.diff(data.time)
    # A descent may try any width; one that is no width at all is thrown out by its objective.
    width = min(max(float(width), 0.0), float(np.ptp(data.time)))
    return min(4 + math.ceil(width / float(steps[steps > 0].min())), data.size + 1)


def _slides(data: Experiments, structure: Structure, z: Coordinates, noise: NoiseModel) -> bool:
    """Tell whether `cascade.run_sliding` does: nothing happens between the samples."""
    return bool(
        structure.friction == "none"
        and not structure.delay
        and z.delay == 0.0
        and data.kind in (SPEED, ANGLE)
        and not data.current.size
        and noise.huber == math.inf
        and not noise.gain.any()
        and data.plain
    )


def evaluate(
    data: Experiments,
    structure: Structure,
    z: Coordinates,
    initial: Array,
    start: Array,
    noise: NoiseModel,
    priors: Sequence[tuple[Array, float]] = (),
) -> Pass:
    """Run, add what is known beforehand, and eliminate the initial states."""
    own = own_columns(data, structure)
    segments, f, o = len(data.starts) - 1, structure.matrix.shape[1], len(own)
    common, score = np.zeros((f, f)), np.zeros(f)
    step, local_gain = np.zeros((segments, o)), np.zeros((segments, o, f))
    if not np.isfinite(z.array).all():  # what predicts no number misses no measurement
        return _nowhere(segments, f, o)
    sums = gather(data, structure, z, initial, noise)
    total = float(sums.cost.sum())
    if not math.isfinite(total):
        return _nowhere(segments, f, o)
    for row, miss in priors:
        common += np.outer(row, row)
        score += row * miss
        total += miss * miss
    known = data.known_initial
    uncurbed = own[0] == 0 and not structure.current  # a measured current tells how it began
    shown = sums.normal[:, f, f] / known[:, 0] if uncurbed else 0.0
    places = list(own)
    value = initial[:, places]
    prior, decrease = eliminate(
        sums.normal, sums.gradient, value - start[:, places], NEAR[places], value,
        known[:, places], data.size, common, score, step, local_gain, sums.scores, sums.owner,
    )  # fmt: skip
    total += prior
    if not (math.isfinite(total) and all(np.isfinite(x).all() for x in (common, score, step))):
        return _nowhere(segments, f, o)
    occam = float(np.log1p(shown).sum())
    return Pass(total, common, score, step, local_gain, decrease, sums.spread, sums.scores[:, :f],
                occam)  # fmt: skip


def _nowhere(segments: int, f: int, o: int) -> Pass:
    """Return the pass of coordinates that predict no numbers."""
    return Pass(math.inf, np.zeros((f, f)), np.zeros(f), np.zeros((segments, o)),
                np.zeros((segments, o, f)), 0.0, np.full(6, np.nan),
                np.zeros((0, f)))  # fmt: skip
