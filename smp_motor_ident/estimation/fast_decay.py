"""A driver that coasts in every PWM period, fitted together with the motor by least squares.

Its voltage follows the motion and the motion that voltage: neither can be fixed while the other is
sought.  Two numbers describe it: L/R in PWM periods, and how much of the voltage at steady speed
is back-EMF.
Derivation: docs/derivations.md, section 13.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import optimize

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.descent import initial_of
from smp_motor_ident.estimation.fit import FASTEST as SHORTEST_LAG
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.selection import POLICY, sandwich_factor
from smp_motor_ident.likelihood.driver_feedback import terminal_voltages
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.passes import own_columns
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.driver import COAST, Driver
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import FirstOrder, SecondOrder, Structure

NUMBERS = 2  # of the driver, beside the motor's
SIZES = (0.1, 1.0, 10.0, 100.0)  # of L/R in PWM periods, at which a descent begins
SHARE = 0.9  # of back-EMF, the same
FASTEST = 0.98  # quantile of speed and of voltage that belong together
LITTLE = 0.02  # of the largest voltage: a friction from which more is found
ALLOWED = {"size": (np.log(1e-3), np.log(1e4)), "share": (0.3, 1.0)}
SHORTEST = 1e-9  # s, of a window
DIFFERENCE = 1e-5  # of each parameter's scale, over which a derivative is taken
STEPS = 40  # of a descent at most
SETTLED = 3  # turns of initial states and the voltage of other data
SECOND = (0.02, 0.2)  # second lags that are tried, of the first


@dataclass(frozen=True, eq=False)
class Joint:
    """A motor and its driver, fitted together."""

    fit: Fit  # the motor, under the voltage of the driver
    driver: Driver
    std: tuple[float, float]  # of L/R in PWM periods and of the back-EMF's share
    voltage: Array  # by sections of the command [V]
    # shape (12,) each: how much less is known of the motor than under a voltage that is known
    moves: tuple[Array, ...]

    @property
    def cost(self) -> float:
        """The deviance with a price for each number."""
        price = POLICY.price(1, self.fit.samples)
        return self.fit.deviance + price * (self.fit.structure.size + NUMBERS)


def fitted(data: Experiments, near: Fit, full_duty: float, options: Options) -> Joint | None:
    """Return a motor behind a coasting driver from a fit that knows of none.

    The first order is sought from many starts, what is richer from its answer.
    """
    first = near.structure.with_(delay=False, load=False, shift=0.0)
    first = FirstOrder.like(first, friction="symmetric")
    problem = _Problem(data, replace(near, structure=first), full_duty)
    starts = [problem.start(z, np.log(size), SHARE) for z in _motors(data, near) for size in SIZES]
    # Far from its minimum a descent does not tell how deep that is: all go on to their ends.
    found = min((problem.descend(p) for p in starts), key=lambda r: float(r.cost))
    best = problem.joint(found, options)
    z, _, driver = problem.unpacked(found.x)
    richer: list[tuple[Structure, Coordinates]] = [(first.with_(delay=True), z)]
    second = SecondOrder.like(first)
    richer += [(second, z.with_second_lag(s * z.time_constant)) for s in SECOND]
    for structure, begin in richer:
        other = _Problem(data, replace(near, structure=structure), full_duty)
        p = other.start(begin, np.log(driver.size), driver.emf_share)
        one = other.joint(other.descend(p), options)
        best = min((j for j in (best, one) if j), key=lambda j: j.cost, default=None)
    return best


def continued(data: Experiments, joint: Joint, options: Options) -> Joint | None:
    """Return the same of more data."""
    near = replace(joint.fit, initial=initial_of(data, joint.fit))
    problem = _Problem(data, near, joint.driver.full_duty)
    p = problem.start(joint.fit.z, np.log(joint.driver.size), joint.driver.emf_share)
    return problem.joint(problem.descend(p), options)


def voltage_of(data: Experiments, joint: Joint) -> Array:
    """Return what the driver puts out in other data of the motor, by sections [V]."""
    fit, voltage = joint.fit, data.hold_value
    for _ in range(SETTLED):
        there = prediction.settle(replace(data, hold_value=voltage), fit)
        voltage = terminal_voltages(data, fit.structure, fit.z, there.initial, joint.driver)
    return voltage


def rows_of(data: Experiments, voltage: Array) -> Array:
    """Return the voltage of each row of one for each section [V]."""
    if data.how != "after":
        return voltage
    last = np.zeros(data.size, dtype=np.bool_)
    last[data.starts[1:] - 1] = True  # a section has the command of the row before it
    return np.where(last, data.voltage, np.roll(voltage, -1))


def _motors(data: Experiments, near: Fit) -> Iterator[Coordinates]:
    """Yield motors to begin with: as it was found, and one of little friction."""
    yield near.z
    there = np.isfinite(data.output)
    speed = data.output[there]
    if data.kind == ANGLE:
        segment = np.searchsorted(data.starts, np.flatnonzero(there), side="right")
        within = np.diff(segment) == 0  # each record has a time of its own
        speed = np.diff(speed)[within] / np.diff(data.time[there])[within]
    gain = np.quantile(np.abs(speed), FASTEST) / np.quantile(np.abs(data.hold_value), FASTEST)
    if gain > 0:
        ln_a0 = -float(np.log(gain))
        z = near.z.with_(ln_a0=ln_a0, ln_a1=near.z.ln_a1 - near.z.ln_a0 + ln_a0)
        yield z.with_friction(LITTLE * float(np.abs(data.hold_value).max()))


class _Problem:
    """The errors by the motor's free coordinates, the driver's numbers and the initial states."""

    def __init__(self, data: Experiments, near: Fit, full_duty: float) -> None:
        self.data, self.near, self.full_duty = data, near, full_duty
        self.structure = near.structure
        self.own = list(own_columns(data, near.structure))
        self.names = (*near.structure.free, "size", "share")
        self.there = np.isfinite(data.output)
        segments = len(data.starts) - 1
        self.owner = np.repeat(np.arange(segments), np.diff(data.starts))[self.there]
        self.weight = 1 / np.sqrt(near.noise[0, 0])
        self.last: tuple[Array, Array] = np.zeros(0), np.zeros(0)

    def start(self, z: Coordinates, size: float, share: float) -> Array:
        """Return parameters: a motor, the logarithm of its driver's size and the share."""
        initial = initial_of(self.data, self.near)
        z = self.structure.complete(z)
        motor = [z.value(n) for n in self.structure.free]
        return np.array([*motor, size, share, *initial[:, self.own].ravel()])

    def unpacked(self, p: Array) -> tuple[Coordinates, Array, Driver]:
        """Return the motor, its initial states, and its driver."""
        there, k = dict(zip(self.names, map(float, p))), len(self.names)
        size, share = float(np.exp(there.pop("size"))), there.pop("share")
        initial = initial_of(self.data, self.near)
        initial[:, self.own] = p[k:].reshape(-1, len(self.own))
        z = self.structure.complete(self.near.z.with_(**there))
        return z, initial, Driver(COAST, size, self.full_duty, share)

    def _shown(self, p: Array) -> tuple[Experiments, Array]:
        """Return the data under the driver's voltage, and what a motor shows under it."""
        z, initial, driver = self.unpacked(p)
        voltage = terminal_voltages(self.data, self.structure, z, initial, driver)
        data = replace(self.data, hold_value=voltage)
        there = replace(self.near, structure=self.structure, z=z, initial=initial)
        return data, prediction.once(data, there)[:, 1]

    def _misses(self, p: Array) -> Array:
        if np.array_equal(p, self.last[0]):  # of which the slopes are asked for next
            return self.last[1]
        self.last = p.copy(), self._missed(p)
        return self.last[1]

    def _missed(self, p: Array) -> Array:
        shown = self._shown(p)[1]
        miss = self.weight * (self.data.output - shown)[self.there]
        # What overflows is far off, yet its square is a number.
        return np.asarray(np.nan_to_num(miss, nan=1e100, posinf=1e100, neginf=-1e100))

    @cached_property
    def _groups(self) -> list[tuple[Integers, float]]:
        """Which parameters are moved at once for a derivative, and by how much."""
        top = float(np.abs(self.data.hold_value).max()) or 1.0
        fastest, lag = top * self.near.z.dc_gain, self.near.z.time_constant
        scale = dict.fromkeys(("vc_plus", "vc_minus", "load"), top)
        scale |= dict.fromkeys(("delay", "window"), self.data.step)
        of_motor = [(np.array([j]), scale.get(n, 1.0)) for j, n in enumerate(self.names)]
        states, every = (top, fastest, fastest * lag, top), len(self.own)
        segment = every * np.arange(len(self.data.starts) - 1) + len(self.names)
        return of_motor + [(segment + j, states[own]) for j, own in enumerate(self.own)]

    @property
    def _scale(self) -> Array:
        """What is much of each parameter; slopes far from the minimum are no measure of that."""
        out = np.ones(len(self.names) + len(self.own) * (len(self.data.starts) - 1))
        for moved, scale in self._groups:
            out[moved] = scale
        return out

    def _slopes(self, p: Array) -> Array:
        here = self._misses(p)
        out = np.zeros((here.size, p.size))
        rows = np.arange(here.size)
        for k, (moved, scale) in enumerate(self._groups):
            there = p.copy()
            there[moved] += DIFFERENCE * scale
            slope = (self._missed(there) - here) / (DIFFERENCE * scale)
            out[rows, k if k < len(self.names) else moved[self.owner]] = slope
        return out

    def descend(self, p: Array, steps: int = STEPS) -> optimize.OptimizeResult:
        """Return where at most so many steps lead."""
        low, high = np.full(p.size, -np.inf), np.full(p.size, np.inf)
        for j, name in enumerate(self.names):
            low[j], high[j] = ALLOWED.get(name, (-np.inf, np.inf))
            if name in ("vc_plus", "vc_minus", "delay", "window"):
                low[j] = SHORTEST if name == "window" else 0.0
            if name == "ln_a2":  # a shorter second lag shows in nothing, and friction chatters
                low[j] = self.unpacked(p)[0].ln_a1 + np.log(SHORTEST_LAG * self.data.step)
        inside = np.nextafter(low, high), np.nextafter(high, low)
        with np.errstate(all="ignore"):  # what runs away has a cost that says so
            found: optimize.OptimizeResult = optimize.least_squares(  # type: ignore[operator]
                self._misses, np.clip(p, *inside), self._slopes, (low, high),
                x_scale=self._scale, max_nfev=steps,
            )  # fmt: skip
        return found

    def joint(self, found: optimize.OptimizeResult, options: Options) -> Joint | None:
        """Return what is found and what is known of it; None where a descent ran away."""
        z, initial, driver = self.unpacked(found.x)
        data = self._shown(found.x)[0]
        fit = solve(data, self.structure, self.near.at(z, initial, 0.0), options)
        if not np.isfinite(fit.deviance):
            return None
        slopes, k = found.jac, len(self.names)
        variance = 2 * found.cost / max(slopes.shape[0] - slopes.shape[1], 1)
        variance *= sandwich_factor(fit)
        together = variance * prediction.inverse(slopes.T @ slopes)[:k, :k]
        of_size, share = np.sqrt(np.diag(together)[-NUMBERS:])
        known = sandwich_factor(fit) * fit.white()
        moves = [fit.structure.matrix @ m for m in _beyond(together[:-NUMBERS, :-NUMBERS], known)]
        std = float(of_size * driver.size), float(share)
        return Joint(fit, driver, std, data.hold_value, tuple(moves))


def _beyond(whole: Array, part: Array) -> list[Array]:
    """Return moves whose outer products add up to what a covariance has beyond another."""
    scale = np.sqrt(np.maximum(np.diag(whole), np.diag(part)))
    values, vectors = np.linalg.eigh((whole - part) / np.outer(scale, scale))
    return [np.sqrt(v) * scale * x for v, x in zip(values, vectors.T, strict=True) if v > 0]
