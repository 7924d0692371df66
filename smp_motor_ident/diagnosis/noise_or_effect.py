"""Whether an effect explains what was taken for torque noise.

A load that fluctuates follows whatever the motor does beside the model: one-step predictions
hardly show what the model lacks, and the numbers give way.  Here the free run is fitted with each
effect (Levenberg-Marquardt), which asks how much of its error the effect explains; then the
innovations are, with the effect of that size and torque noise of an intensity found anew.  The
two fits of the innovations are held against each other by their Bayes factor (Schwarz's
approximation).  Where there is no effect, it exceeds ``n / a`` for one of ``n`` of them with a
probability of at most ``a`` (Markov's inequality).

References
----------
G. Schwarz, Annals of Statistics 6 (1978), 461; R. Kass, A. Raftery, Bayes factors, JASA 90 (1995).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.adequacy import Evidence
from smp_motor_ident.diagnosis.effects import EFFECTS, FALLING_FRICTION, Effect
from smp_motor_ident.diagnosis.limits import EFFECT_LEVEL
from smp_motor_ident.diagnosis.model_error import (
    Signal,
    measured,
    motions,
    own_responses,
    predicted,
    responses,
    signals,
    stacked,
    together,
    whitened,
)
from smp_motor_ident.estimation import data_window
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.selection import sandwich_factor
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import LOGARITHMS
from smp_motor_ident.model.driver import EFFECTS as DRIVERS

COST = 20_000  # samples of all runs in which effects are tried beyond their linear ranking
STEPS = 12  # of Levenberg and Marquardt at most
FIRST = 1e-5  # damping at which they begin, of the diagonal
FOLDS = 5.0  # that a coordinate may change by in one step
FARTHEST = 1e12  # rad, rad/s or A that a free run may reach
ROUNDING = 1e-12  # damping at which normal equations can be solved whatever they are
SETTLED = 0.01  # of all that was gained, below which a line hopes for no step more
REWEIGHTED = 3  # passes in which each output gets the variance of its own errors


def in_place_of_noise(
    data: Experiments, fit: Fit, gear: float, options: Options
) -> tuple[Evidence, Experiments, Fit] | None:
    """Return the effect that explains what was taken for torque noise, and the motor beside it."""
    if not np.any(fit.gain != 0.0):
        return None
    here = _linearised(data, replace(fit, gain=np.zeros_like(fit.gain)), EFFECTS, gear)
    if here is None:
        return None
    price = float(np.log(data.size))
    runs = [(_settled(here, effect, gear), effect) for effect in here.most_likely()]
    run, effect = min(runs, key=lambda r: r[0].deviance + len(r[0].signals) * price)
    again = data_window.grow(run.data, fit.structure, replace(fit, z=run.fit.z), options)
    gain = (fit.deviance - again.deviance) / sandwich_factor(fit) - len(run.signals) * price
    chance = len(EFFECTS) * float(np.exp(min(-0.5 * gain, 0.0)))
    if chance > EFFECT_LEVEL.value:
        return None
    moved = np.linalg.lstsq(fit.structure.matrix, again.z.array - fit.z.array, rcond=None)[0]
    shown = Evidence(effect, chance, gain, np.asarray(-moved, dtype=np.float64), ())
    return shown, run.data, again


def instead_of_drag(data: Experiments, fit: Fit, gained: float, gear: float) -> list[Fit] | None:
    """Return the motors beside effects that explain as much as a drag; None if one explains more.

    Friction that falls with speed, above all, bends the line of steady speeds as a drag does.
    ``gained``: deviance that the drag explains.
    """
    searched = {e.code for e in DRIVERS} | {FALLING_FRICTION.code}
    tried = [FALLING_FRICTION, *(e for e in EFFECTS if e.code not in searched)]
    here = _linearised(data, replace(fit, gain=np.zeros_like(fit.gain)), tried, gear)
    if here is None:
        return []
    without, price = here.fitted(list(range(here.own)))[1], float(np.log(data.size))
    others = [_settled(here, e, gear) for e in here.most_likely()]
    ahead = [without - o.deviance - price * (len(o.signals) - 1) - gained for o in others]
    if max(ahead) > 0:
        return None
    near = price * sandwich_factor(fit)
    return [replace(fit, z=o.fit.z) for o, by in zip(others, ahead, strict=True) if by > -near]


@dataclass(frozen=True, eq=False)
class _Point:
    """The free run at some coordinates and sizes of effects, and its responses there."""

    data: Experiments  # with the effects so far in voltage, output and current
    fit: Fit
    signals: list[tuple[Effect, Signal]]
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
        free = len(self.fit.structure.free)
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

    def only(self, effect: Effect) -> "_Point":
        """Return the same run with the responses to one effect alone."""
        own = [k for k, (e, _) in enumerate(self.signals) if e is effect]
        keep = [*range(self.own), *(self.own + k for k in own)]
        return _Point(self.data, self.fit, [self.signals[k] for k in own], self.error,
                      self.table[:, :, keep], self.length[keep])  # fmt: skip

    def most_likely(self) -> list[Effect]:
        """Return the effects that explain most, as far as a line tells."""
        price, tried = float(np.log(self.data.size)), []
        for effect in dict.fromkeys(e for e, _ in self.signals):
            alone = self.only(effect)
            deviance = alone.fitted(list(range(alone.length.size)))[1]
            tried.append((deviance + price * len(alone.signals), effect))
        tried.sort(key=lambda t: t[0])
        return [effect for _, effect in tried[: max(2, COST // self.data.size)]]

    def moved(self, damping: float, effect: Effect, gear: float) -> "_Point | None":
        """Return the free run after a Levenberg-Marquardt step; None where it leaves all bounds."""
        step = self.fitted(list(range(self.length.size)), damping)[0]
        structure = self.fit.structure
        z = self.fit.z.moved(structure.matrix @ step[: len(structure.free)])
        if max(abs(z.value(n) - self.fit.z.value(n)) for n in LOGARITHMS) > FOLDS:
            return None
        z = z.with_(vc_plus=max(z.vc_plus, 0.0), vc_minus=max(z.vc_minus, 0.0))
        data = self.data
        for (_, signal), size in zip(self.signals, step[self.own :], strict=True):
            data = signal.within(data, float(size))
        return _linearised(data, replace(self.fit, z=structure.complete(z)), [effect], gear)


def _linearised(
    data: Experiments, fit: Fit, effects: Sequence[Effect], gear: float
) -> _Point | None:
    """Return the free run and what coordinates, initial states and effects change in it.

    None where that is out of all bounds.
    """
    base = predicted(data, fit)
    if not (np.abs(base) < FARTHEST).all():
        return None
    sections, samples = motions(data, fit, gear)
    if not all((np.abs(m.drop) < FARTHEST).all() for m in (sections, samples)):
        return None
    made = [(effect, signal) for effect in effects for signal in signals(effect, sections, samples)]
    own = whitened(data, fit, own_responses(data, fit, together(data)))
    table = np.array([*own, *whitened(data, fit, responses(data, fit, (s for _, s in made)))])
    if not np.isfinite(table).all():
        return None
    length = np.sqrt(np.square(table).sum(axis=1))
    length[~(length > 0)] = 1.0
    outputs = 1 + bool(data.current.size)
    table = np.moveaxis((table / length[:, None]).reshape(length.size, outputs, -1), 0, -1)
    error = stacked(data, fit, measured(data) - base).reshape(outputs, -1)
    return _Point(data, fit, made, error, table, length)


def _settled(here: _Point, effect: Effect, gear: float) -> _Point:
    """Return the free run with an effect at the coordinates and size that fit it best."""
    best, damping = here.only(effect), FIRST
    without = here.fitted(list(range(here.own)))[1]
    for _ in range(STEPS):
        hoped = best.deviance - best.fitted(list(range(best.length.size)))[1]
        if hoped < SETTLED * max(without - best.deviance, 0.0) + 1.0 or damping > 1.0:
            break
        near = best.moved(damping, effect, gear)
        if near is None or not near.deviance < best.deviance:
            damping *= 30
            continue
        best, damping = near, damping / 10
    return best


def _deviance(squares: Array, error: Array) -> float:
    """Return minus twice the log-likelihood of white errors, but for a constant."""
    known = np.maximum(np.count_nonzero(error, axis=1), 1)
    return float(known @ np.log(np.maximum(squares, 1e-300) / known))
