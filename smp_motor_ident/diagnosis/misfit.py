"""What the intervals take up of a model that is not all of the motor, beside what is named.

That are numbers which hang on how closely an observer follows, friction that a load's fluctuations
smooth, and commands that took effect at instants that scatter, which the variance of the residuals
tests.  A driver on its own clock, a bus or arrival stamps put every change of the command off by a
time of its own.  With independent times of mean zero and variance s2, residuals ``e`` of variance
one have the variance

    1 + s2 x,   x_t = sum_k (d yhat_t / d t_k)^2,

over the changes ``k`` of the command, where no other noise knows when it changed.  The regression
of ``e^2`` on ``x`` gives s2, with a standard deviation that allows for any other variance (White).
A noise that hangs on the speed does know: what a coarse speed is rounded by, of a motor at rest by
nothing.  Both are held against others at that speed alone (Frisch, Waugh and Lovell).
Times that are never negative have a mean beside their scatter: where they are uniform from nothing
to a period, the square of the mean is three times the variance.

References
----------
T. Breusch, A. Pagan, A simple test for heteroscedasticity, Econometrica 47 (1979), 1287;
H. White, Econometrica 48 (1980), 817.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.linalg import hadamard
from scipy.special import erfc

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.diagnosis.limits import CONDITION_LEVEL
from smp_motor_ident.diagnosis.model_error import ROWS, answered, carried, measured, predicted
from smp_motor_ident.diagnosis.observers import slower
from smp_motor_ident.diagnosis.smoothed_friction import smoothed
from smp_motor_ident.estimation.consider_covariance import consider_late
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.quantities import Answer
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments

Said = tuple[Answer, dict[str, float]]
"""What is stated, and the weights of structures between which the data do not decide."""


def widened_by_misfit(
    data: Experiments, fit: Fit, said: Callable[[Fit], Said], options: Options
) -> tuple[Said, list[Finding]]:
    """Return what is stated with what three tests show, and say so.

    Where a number would be lost in an interval so wide, it stays as it is and is unreliable.
    """
    wide, slow = slower(data, fit)
    wide, late = jittered(data, wide)
    wide, held = smoothed(data, wide, options)
    before = said(fit)
    if wide is fit:
        return before, []
    after = said(wide)
    lost = [
        name
        for name, quantity in before[0].combinations.items()
        if quantity.value is not None and after[0].combinations[name].value is None
    ]
    if not lost:
        return after, [*slow, *late, *held]
    words = f"; that leaves nothing of {' and '.join(lost)}, which the intervals do not cover"
    return before, [
        replace(f, severity="unreliable", message=f.message.partition(":")[0] + words)
        for f in (*slow, *late, *held)
    ]


PATTERNS = 8  # of signs, whose mean square is the sum over the changes
LEVELS = 32  # of speed, between which a noise may differ
MOST = 4.0  # deviations at which a residual is cut off: outliers are no scatter


def jittered(data: Experiments, fit: Fit) -> tuple[Fit, list[Finding]]:
    """Return the fit with its covariance widened by instants that scatter, and say so."""
    scatter = _scatter(data, fit) if fit.structure.free else 0.0
    if scatter <= 0.0:
        return fit, []
    late = math.sqrt(3.0 * scatter)
    change = np.square(np.delete(np.diff(data.hold_value), data.hold_start[1:-1] - 1))
    often = float(change.sum()) / (data.size * data.step)
    if 2.0 * late * often * float(change.sum()) > float(change @ change):
        return fit, []  # a command that is later than the next one never acts
    wider = consider_late(data, fit, late)
    impulses = math.sqrt(scatter * often)
    return wider, [
        Finding(
            "command_jitter",
            "note",
            f"right after changes of the command the residuals scatter as if it took effect up to "
            f"{2e3 * late:.2g} ms late, each time by another: the intervals cover that",
            {"delay": late, "scatter": math.sqrt(scatter), "as_noise": impulses},
            "record the voltage at the motor's terminals, with the stamps of one clock",
        )
    ]


def _scatter(data: Experiments, fit: Fit) -> float:
    """Return the variance [s^2] of the instants, nothing where chance may be it."""
    rng = np.random.default_rng(0)
    voltage, values = data.hold_value, measured(data)
    base, deviation = predicted(data, fit), np.sqrt(np.diag(fit.noise))[: values.shape[1]]
    change = np.diff(voltage, prepend=voltage[0])
    change[data.hold_start[:-1]] = 0.0
    length = np.maximum(np.diff(data.hold_end, prepend=data.hold_end[0] - data.step), 0.0)
    length[data.hold_start[:-1]] = data.step
    moved = np.divide(change, length, out=np.zeros_like(change), where=length > 1e-3 * data.step)
    x = np.zeros_like(base)
    # Patterns of signs that are orthogonal over as many changes in a row, and random from then on.
    moved *= 2.0 * rng.integers(0, 2, moved.size) - 1.0
    signs, nth = hadamard(PATTERNS, np.float64), np.cumsum(moved != 0.0) % PATTERNS
    several = carried(data, PATTERNS)
    for n in range(0, PATTERNS, several):
        made = signs[n : n + several].take(nth, axis=1) * moved
        moves = answered(data, fit, (made, np.zeros((0, 0, 0))), 1)
        x += np.einsum("noc,noc->no", moves, moves) / PATTERNS
    x /= np.square(deviation)
    known = np.isfinite(values)
    square = np.minimum(np.square((values - base) / deviation)[known], MOST**2)
    level = np.broadcast_to(_level(data, base[:, 0])[:, None], known.shape)[known]
    count = np.maximum(np.bincount(level), 1)
    away, square = (v - (np.bincount(level, v) / count)[level] for v in (x[known], square))
    spread = float(away @ away)
    if not spread > 0.0:
        return 0.0
    found = float(away @ square) / spread
    left = square - found * away
    robust = math.sqrt(float(np.square(away * left).sum())) / spread
    plain = float(square.std()) / math.sqrt(spread)
    surprise = found / max(robust, plain, 1e-300)
    return found if 0.5 * erfc(surprise / math.sqrt(2)) < CONDITION_LEVEL.value else 0.0


def _level(data: Experiments, output: Array) -> Integers:
    """Return at which level of speed each sample is, of `LEVELS`."""
    speed = output
    for _ in range(data.kind.integrals):
        speed = np.diff(speed, prepend=speed[0])
        speed[data.starts[:-1]] = 0.0
    low, high = np.percentile(speed[:: max(1, speed.size // ROWS)], (1, 99))
    share = (speed - low) * ((LEVELS - 1) / max(high - low, 1e-300))
    return np.asarray(np.clip(share + 0.5, 0.0, LEVELS - 0.5), dtype=np.int64)
