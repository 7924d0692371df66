"""Whether an effect explains without torque noise what was taken for torque noise.

A load that fluctuates follows whatever the motor does beside the model, so one-step predictions
hardly show what the model lacks.  Here the free run with an effect, ``y = f(z, c) + white noise``,
is fitted (Levenberg-Marquardt) and held against the innovations: two models that are not nested, compared
by their Bayes factor (Schwarz's approximation).  Where the torque noise is true, that factor exceeds
``n / a`` for one of ``n`` effects with a probability of at most ``a`` (Markov's inequality).

References
----------
G. Schwarz, Annals of Statistics 6 (1978), 461; R. Kass, A. Raftery, Bayes factors, JASA 90 (1995).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.diagnosis.adequacy import ROUNDS, Evidence, Stated, as_finding
from smp_motor_ident.diagnosis.effects import EFFECTS, Effect
from smp_motor_ident.diagnosis.limits import EFFECT_LEVEL
from smp_motor_ident.diagnosis.model_error import (
    Regression,
    measured,
    motions,
    own_responses,
    predicted,
    response,
    stacked,
)
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model import structures as models

Array = NDArray[np.float64]

COST = 40_000  # samples of all runs in which effects are tried beyond their linear ranking
STEPS = 12  # of Levenberg and Marquardt at most
FIRST = 1e-5  # damping at which they begin, of the diagonal
ROUNDING = 1e-12  # damping at which normal equations can be solved whatever they are
SETTLED = 1.0  # deviance by which a last step lowers it
REWEIGHTED = 3  # passes in which each output gets the variance of its own errors


def in_place_of_noise(
    data: Experiments,
    fit: Fit,
    errors: Regression | None,
    gear: float,
    numbers: Sequence[Stated],
) -> list[Finding]:
    """Name the effect (or two or three together) that does without torque noise, if one does."""
    if errors is None or not np.any(fit.gain != 0.0):
        return []
    shown = _preferred(data, fit, errors, gear)
    return [] if shown is None else [as_finding(shown, [shown], numbers, data.step)]


def _preferred(data: Experiments, fit: Fit, errors: Regression, gear: float) -> Evidence | None:
    each = float(np.log(np.count_nonzero(errors.residual)))
    rows = errors.residual.reshape(1 + bool(data.current.size), -1)
    noise = _deviance(np.square(rows).sum(axis=1), rows) + each  # charged for its intensity
    here = _linearised(data, replace(fit, gain=np.zeros_like(fit.gain)), EFFECTS, gear)
    chosen: list[Effect] = []
    for _ in range(ROUNDS):
        runs = [
            (_settled(here, [*chosen, more], noise, gear), more) for more in here.next_effects(chosen)
        ]
        if not runs:
            return None
        run, more = min(runs, key=lambda r: r[0].deviance + len(r[0].signals) * each)
        chosen.append(more)
        gain = noise - run.deviance - len(run.signals) * each
        chance = float(np.exp(min(len(chosen) * np.log(len(EFFECTS)) - 0.5 * gain, 0.0)))
        if chance < EFFECT_LEVEL.value:
            moved = np.linalg.lstsq(fit.structure.matrix(), run.fit.z - fit.z, rcond=None)[0]
            return Evidence(chosen[0], chance, gain, -moved, ())
        if run.deviance - noise > 0.5 * (here.deviance - noise):
            return None  # noise it is, for the most part
    return None


@dataclass(frozen=True, eq=False)
class _Point:
    """The free run at some coordinates and sizes of effects, and its responses there."""

    data: Experiments  # with the effects so far in voltage, output and current
    fit: Fit
    signals: list[tuple[Effect, Array]]
    error: Array  # shape (o, n): whitened, of each output
    # shape (o, n, f + s + r): responses to free coordinates, initial states and signals, each of
    # unit length, and what length they had
    table: Array
    length: Array

    @property
    def own(self) -> int:
        """Number of free coordinates and initial states."""
        return self.length.size - len(self.signals)

    @cached_property
    def _products(self) -> tuple[Array, Array, Array]:
        normal = np.array([t.T @ t for t in self.table])
        product = np.einsum("onr,on->or", self.table, self.error)
        return normal, product, np.square(self.error).sum(axis=1)

    @cached_property
    def deviance(self) -> float:
        """Minus twice the log-likelihood, the initial states fitted."""
        free = len(self.fit.structure.free())
        return self.fitted(list(range(free, self.own)))[1]

    def fitted(self, columns: list[int], damping: float = 0.0) -> tuple[Array, float]:
        """Fit columns, each output by its own variance; return their sizes and the deviance."""
        normal, product, squares = self._products
        normal, product, left = normal[:, columns][:, :, columns], product[:, columns], squares
        size = np.zeros(len(columns))
        for _ in range(REWEIGHTED if columns else 0):
            weight = left[0] / np.maximum(left, 1e-300)
            a = np.einsum("o,ors->rs", weight, normal)
            a = a + max(damping, ROUNDING) * np.diag(np.diag(a)) + 1e-300 * np.eye(size.size)
            size = np.linalg.solve(a, weight @ product)
            left = squares - 2 * product @ size + np.einsum("ors,r,s->o", normal, size, size)
            left = np.maximum(left, 1e-14 * squares)
        return size / self.length[columns], _deviance(left, self.error)

    def next_effects(self, chosen: Sequence[Effect]) -> list[Effect]:
        """Return the effects that with those chosen explain most, as far as a line tells."""
        tried = []
        for effect in dict.fromkeys(e for e, _ in self.signals if e not in chosen):
            own = [k for k, (e, _) in enumerate(self.signals) if e in (*chosen, effect)]
            deviance = self.fitted([*range(self.own), *(self.own + k for k in own)])[1]
            tried.append((deviance + float(np.log(self.error.size)) * len(own), effect))
        return [e for _, e in sorted(tried, key=lambda t: t[0])[: max(2, COST // self.data.size)]]

    def moved(self, damping: float, effects: Sequence[Effect], gear: float) -> _Point:
        """Return the free run after a Levenberg-Marquardt step."""
        step = self.fitted(list(range(self.length.size)), damping)[0]
        structure = self.fit.structure
        z = self.fit.z + structure.matrix() @ step[: len(structure.free())]
        friction = [models.VC_PLUS, models.VC_MINUS]
        z[friction] = np.maximum(z[friction], 0.0)
        data = self.data
        for (effect, signal), size in zip(self.signals, step[self.own :], strict=True):
            if effect.place == "voltage":
                data = replace(data, hold_value=data.hold_value + size * signal)
            elif effect.place == "output":
                data = replace(data, output=data.output - size * signal)
            else:
                data = replace(data, current=data.current - size * signal)
        return _linearised(data, replace(self.fit, z=structure.complete(z)), effects, gear)


def _linearised(data: Experiments, fit: Fit, effects: Sequence[Effect], gear: float) -> _Point:
    """Return the free run and what coordinates, initial states and effects change in it."""
    base = predicted(data, fit)
    sections, samples = motions(data, fit, gear)
    signals = [
        (effect, signal)
        for effect in effects
        if effect.place != "current" or data.current.size
        for signal in effect.regressors(sections if effect.place == "voltage" else samples)
    ]
    columns = own_responses(data, fit, base)
    columns += [response(data, fit, base, effect, signal) for effect, signal in signals]
    table = np.array([stacked(data, fit, c) for c in columns])
    length = np.sqrt(np.square(table).sum(axis=1))
    length[~(length > 0)] = 1.0
    outputs = 1 + bool(data.current.size)
    table = np.moveaxis((table / length[:, None]).reshape(length.size, outputs, -1), 0, -1)
    error = stacked(data, fit, measured(data) - base).reshape(outputs, -1)
    return _Point(data, fit, signals, error, table, length)


def _settled(here: _Point, effects: Sequence[Effect], noise: float, gear: float) -> _Point:
    """Return the free run with effects at the coordinates and sizes that fit it best.

    A step ends it that comes nearer to the deviance with torque noise by a hundredth only.
    """
    best = _linearised(here.data, here.fit, effects, gear)
    damping = FIRST
    for _ in range(STEPS):
        near = best.moved(damping, effects, gear)
        if not near.deviance < best.deviance:
            damping *= 30
            continue
        settled = best.deviance - near.deviance < max(SETTLED, 0.01 * (near.deviance - noise))
        best, damping = near, damping / 10
        if settled:
            break
    return best


def _deviance(squares: Array, error: Array) -> float:
    """Return minus twice the log-likelihood of white errors, but for a constant."""
    known = np.maximum(np.count_nonzero(error, axis=1), 1)
    return float(known @ np.log(np.maximum(squares, 1e-300) / known))
