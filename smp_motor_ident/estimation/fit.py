"""Least squares on the innovations: Levenberg-Marquardt steps and the noise.

Derivation: docs/derivations.md, section 8.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import MOST_FRICTION, SUBSET_HOPELESS
from smp_motor_ident.estimation import shape_constraint
from smp_motor_ident.estimation.fitted import Fit, Options, Prior, Start
from smp_motor_ident.estimation.memory import remembered
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.noise import NoiseModel, deviance, gain_for, proper, renewed
from smp_motor_ident.likelihood.normal_equations import damped_step
from smp_motor_ident.likelihood.passes import Pass, evaluate, own_columns
from smp_motor_ident.model.coordinates import LOGARITHMS, NAMES, Coordinates
from smp_motor_ident.model.physical import physical_gradients
from smp_motor_ident.model.structures import Structure

__all__ = ["Fit", "Options", "Prior", "Start", "solve"]


STALL = 4, 0.02  # passes that together gain less deviance than this end a descent
PACE = 4  # passes by which it is judged how fast a descent goes
FIRST = 1e-3  # damping at which a descent begins
FREE = 0.1  # damping (relative to the diagonal) below which a step counts as undamped
LARGEST = 80.0  # logarithm of a coordinate: 1e35
CLOSE = 0.3  # of the tolerance, within which a step is not even tried where there are kinks
FASTEST = 1e-3  # of a sample: a lag below it shows in nothing, and leaves the coordinates stiff
SHORTEST = 1e-9  # s: a window, or a lag, that is as good as none
ROUNDS = 12  # most times that the noise is estimated anew


class _Descent:
    """A fit under way: where it is, and what the last pass gave there."""

    def __init__(
        self,
        data: Experiments,
        structure: Structure,
        start: Start,
        options: Options,
        bounds: tuple[Coordinates, Coordinates],
        known: Fit | None,
    ) -> None:
        self.data, self.structure, self.options, self.known = data, structure, options, known
        self.noise_ratio, self.bounds = start.noise_ratio, bounds
        self.lower, self.upper = (b.array for b in bounds)
        self.matrix = structure.matrix
        self.own = own_columns(data, structure)
        self.current = data.current.size > 0
        self.shaped = shape_constraint.applies(structure)
        self.z = self._allowed(start.z)
        self.start, self.initial = start.initial.copy(), start.initial.copy()
        self.smooth = structure.friction == "none" and not structure.delay
        self.only_scale = not self.current and options.huber == math.inf and start.noise_ratio == 0
        self.damping, self.passes, self.converged = FIRST, 0, False
        self.trail: list[float] = []
        self.look(proper(start.noise))

    def _allowed(self, z: Coordinates) -> Coordinates:
        """Return coordinates brought within the bounds and to a motor that can be."""
        z = Coordinates.of(np.minimum(np.maximum(z.array, self.lower), self.upper))
        free, shortest = self.structure.free, math.log(FASTEST * self.data.step)
        if "ln_a1" in free:
            z = z.with_(ln_a1=max(z.ln_a1, z.ln_a0 + shortest))
        if "ln_a2" in free:
            z = z.with_(ln_a2=max(z.ln_a2, z.ln_a1 + shortest))
        z = self.structure.complete(z)
        return shape_constraint.within(z) if self.shaped else z

    def _pass(self, z: Coordinates, initial: Array) -> Pass:
        self.passes += 1
        return evaluate(
            self.data, self.structure, z, initial, self.start, self.noise,
            _linearise(self.options.priors, z, self.matrix),
        )  # fmt: skip

    def look(self, covariance: Array) -> None:
        """Pass where it is, with this noise and the gain that goes with it."""
        gain = gain_for(self.structure, self.z, self.data.kind, self.data.step,
                        self.noise_ratio, covariance,
                        self.current and not self.structure.lags)  # fmt: skip
        self.noise = NoiseModel(covariance, gain, self.options.huber)
        self.here: Pass = self._pass(self.z, self.initial)

    def look_again(self, covariance: Array) -> None:
        """Do the same for another noise; where it is but another scale, without a pass."""
        if self.only_scale and not self.options.priors:
            self.here = self.here.scaled(float(self.noise.covariance[0, 0] / covariance[0, 0]))
            self.noise = replace(self.noise, covariance=covariance)
        else:
            self.look(covariance)

    def step(self) -> tuple[Coordinates, Array, float]:
        """Return where the damped step leads, and its length in standard deviations."""
        here = self.here
        step, size = self._solved(self.damping)
        z = self._allowed(self.z.moved(self.matrix @ step))
        moved = self.initial.copy()
        # Initial states alone are a small problem, and shorten their own step where it led up.
        share = 1.0 if self.matrix.shape[1] else min(1.0, math.sqrt(FIRST / self.damping))
        moved[:, list(self.own)] += share * here.local_step - here.local_gain @ step
        return z, moved, size

    def within(self, tolerance: float, size: float) -> bool:
        """Tell whether a step is so small that another pass would not tell more."""
        own = self.here.local_decrease
        return size < tolerance and 0 <= own < tolerance**2

    def settled(self) -> bool:
        """Tell whether an undamped step would stay within half a standard deviation."""
        return self._solved(1e-9)[1] < 0.5

    def arrived(self) -> bool:
        """Tell whether it is within a standard deviation of a fit that is known: it ends there."""
        known = self.known
        if known is None or not known.converged or known.structure != self.structure:
            return False
        away = self.structure.of_free(self.z.array - known.z.array)
        return bool(away @ known.information @ away < 1.0)

    def hopeless(self, left: int) -> bool:
        """Tell whether steps as they have been of late do not lead near what is known in time."""
        self.trail.append(deviance(self.here.spread))
        if self.known is None or self.known.samples != self.data.size or len(self.trail) <= PACE:
            return False
        above = self.trail[-1] - self.known.deviance - SUBSET_HOPELESS.value
        return above > left * (self.trail[-1 - PACE] - self.trail[-1]) / PACE

    def _solved(self, damping: float) -> tuple[Array, float]:
        """Return the damped step and its length; along the edge of a motor's shapes, if there."""
        normal, gradient = self.here.normal, self.here.gradient
        turn = _physical_steps(self.z, self.structure)
        step, size = damped_step(
            turn.T @ normal @ turn,
            turn.T @ gradient,
            damping,
            self.matrix @ turn,
            self.z.array,
            self.lower,
            self.upper,
        )
        step = turn @ step
        share = shape_constraint.passed(self.z.moved(self.matrix @ step)) if self.shaped else None
        ties = None if share is None else shape_constraint.tied(self.structure, self.z, share)
        if ties is None:
            return step, size
        along, first = ties
        short, _ = damped_step(
            along.T @ normal @ along, along.T @ (gradient - normal @ first), damping,
            self.matrix @ along, self.z.array, self.lower, self.upper,
        )  # fmt: skip
        step = along @ short + first
        return step, math.sqrt(max(float(step @ normal @ step), 0.0))

    def descend(self, iterations: int, tolerance: float, first: bool) -> None:
        """Step until the end, or (the first time) until the noise is worth another look."""
        recent: list[float] = []
        self.converged = False
        while self.passes < iterations and not self.hopeless(iterations - self.passes):
            before = self.here.objective
            z, initial, size = self.step()
            near = tolerance if self.smooth else tolerance * CLOSE
            if self.damping < FREE and self.within(near, size):
                if self.smooth:  # elsewhere a kink may lie between
                    self.z, self.initial = z, initial
                self.converged = True
                return
            new = self._pass(z, initial)
            # A step may be small because it is damped: only a nearly free one tells the end.
            small = self.matrix.shape[1] > 0 and size < tolerance and self.damping < FREE
            gained = max(before - new.objective, 0.0)
            if new.objective <= before:
                recent.append(gained * self.data.size / max(before, 1e-300))
            if len(recent) >= STALL[0] and sum(recent[-STALL[0] :]) < STALL[1]:
                self.converged = self.settled()
                return
            if new.objective <= before * (1 + 1e-12):
                self.z, self.initial, self.here = z, initial, new
                if self.arrived():
                    return
                self.damping = max(self.damping * 0.1, 1e-9)
                if small or (gained < 1e-9 * new.objective and self.damping < FREE):
                    self.converged = True
                    return
                if first and gained < 1e-3 * new.objective and not small:
                    return
            else:
                if small:
                    self.converged = True
                    return
                self.damping = max(self.damping, 1e-6) * 8
                if self.damping > 1e6:  # a kink: no step leads down, small or large
                    self.converged = self.settled()
                    return

    def result(self) -> Fit:
        """Return the fit as it stands."""
        here, noise = self.here, self.noise.covariance
        information, scores = here.normal, here.scores
        value = math.inf
        if math.isfinite(here.objective):
            noise, value = renewed(here.spread, noise, self.current), deviance(here.spread)
            own = list(self.own)
            value += float((self.data.known_initial * np.square(self.initial))[:, own].sum())
            value += here.occam
            if not self.current:
                grow = self.noise.covariance[0, 0] / noise[0, 0]
                information, scores = information * grow, scores * grow
        return Fit(
            structure=self.structure,
            z=self.z,
            initial=self.initial,
            noise=noise,
            noise_ratio=self.noise_ratio,
            gain=self.noise.gain,
            objective=here.objective,
            deviance=value,
            information=information,
            scores=scores,
            passes=self.passes,
            converged=self.converged and math.isfinite(here.objective),
            samples=self.data.size,
            kind=self.data.kind,
        )


def solve(
    data: Experiments,
    structure: Structure,
    start: Start,
    options: Options | None = None,
    iterations: int = 40,
    tolerance: float = 1e-2,
    known: Fit | None = None,
) -> Fit:
    """Minimise the innovations' sum of squares from a start, noise covariance included.

    Levenberg-Marquardt in z with the initial states eliminated; the noise covariance is
    re-estimated from the residuals until it stays (concentrated likelihood).  A descent that
    comes as near to a fit that is ``known`` as the data tell would end there: that is returned.
    One that is far above it and does not come nearer in its passes is given up.
    """
    options = options or Options()
    bounds = remembered(data, "bounds", 1, (), lambda: _bounds(data))
    descent = _Descent(data, structure, start, options, bounds, known)
    for n in range(ROUNDS):
        if not math.isfinite(descent.here.objective):
            break
        descent.descend(iterations, tolerance, n == 0)
        if known is not None and descent.arrived():
            return known
        before = descent.noise.covariance
        fresh = renewed(descent.here.spread, before, descent.current)
        same = np.abs(np.log(np.diag(fresh) / np.diag(before))).max() < 2e-2
        done = descent.converged and (same or descent.only_scale)
        if descent.passes >= iterations or done or n + 1 == ROUNDS:
            break
        descent.look_again(fresh)
    return descent.result()


def _physical_steps(z: Coordinates, structure: Structure) -> Array:
    """Return steps of a0, tm, be and te in the free coordinates, shape (f, f).

    Where L/R is far below the motor's lag, ``a1 = tm + te be`` and ``a2 = te tm`` must move
    together to a millionth for the motor to stay one; damped each by itself they hold the
    descent.  Damping acts on steps of these instead.
    """
    free = structure.free
    turn = np.eye(len(free))
    if not {"ln_a0", "ln_a1", "ln_a2", "ln_te"} <= set(free):
        return turn
    a0, a1, te = z.a0, z.a1, z.electrical_time_constant
    i, j, k = (free.index(c) for c in ("ln_a1", "ln_a2", "ln_te"))
    tm = np.float64(z.a2) / te
    turn[i, i], turn[i, j], turn[i, k] = te * a0 / a1, tm / a1, 1 - tm / a1
    turn[j, i], turn[j, j], turn[j, k] = 0.0, 1.0, 1.0
    return turn


def _bounds(data: Experiments) -> tuple[Coordinates, Coordinates]:
    """Return bounds: what floating point can hold, and no negative volts or seconds."""
    free = dict.fromkeys(NAMES, math.inf)
    logarithms = dict.fromkeys(LOGARITHMS, LARGEST)
    # Friction next to the largest voltage would put off a motor's start as long as one likes.
    most = MOST_FRICTION.value * float(np.abs(data.hold_value).max(initial=0.0))
    longest = max(float(np.ptp(data.time)), data.step)  # beyond it a sensor shows no motion at all
    late = {"delay": longest, "window": 2 * longest, "current_lag": longest}
    upper = Coordinates(**{**free, **logarithms, **late}).with_friction(max(most, 1e-9))
    lower = Coordinates.of(-upper.array).with_friction(0.0).with_(delay=0.0)
    lower = lower.with_(window=SHORTEST, current_lag=SHORTEST)
    if data.quantum > 0:  # a speed in coarse steps is a difference of counts, over a sample or more
        lower = lower.with_(window=data.step)
    if data.current.size:
        fastest = FASTEST * data.step
        lower = lower.with_(ln_te=math.log(fastest), current_lag=fastest)
    return lower, upper


def _linearise(priors: Sequence[Prior], z: Coordinates, matrix: Array) -> list[tuple[Array, float]]:
    if not priors:
        return []
    known = physical_gradients(z)
    return [
        (known[p.name][1] @ matrix / p.std, (p.value - known[p.name][0]) / p.std) for p in priors
    ]
