"""A driver whose voltage follows the motion, fitted together with the motor by least squares.

The motion follows that voltage, too: neither can be fixed while the other is sought.  Two numbers
describe it, its size (of one that coasts in every PWM period L/R in such periods) and how much of
the voltage at steady speed is back-EMF; of one that coasts at a command of zero the second.
Derivation: docs/derivations.md, section 13.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product

import numpy as np
from scipy import optimize

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.descent import initial_of
from smp_motor_ident.estimation.driver_rows import measured_speed
from smp_motor_ident.estimation.fit import FASTEST as SHORTEST_LAG
from smp_motor_ident.estimation.fit import Fit, Options, solve
from smp_motor_ident.estimation.selection import POLICY, sandwich_factor
from smp_motor_ident.estimation.start import cutoffs, speed_candidates
from smp_motor_ident.likelihood.driver_feedback import terminal_voltages
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.passes import own_columns
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.driver import COAST, COASTING, FREE, Driver, Rows
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import FirstOrder, SecondOrder, Structure

BACK = (0.9, 0.6, 0.4, 0.25, 0.15)  # of the full voltage: back-EMF at the largest speed, the same
BANDS = 4  # cut-offs of their filters
APART = 0.3  # e-folds by which starts differ of which the descents may end apart
BEGUN = 4  # starts from which it is descended, at most
SPAN = 20  # samples over which an angle that is predicted drifts little
MOVES, SEEN = 0.02, 5  # of the largest speed, and sections, above which coasting shows
FASTEST = 0.999  # quantile of the speed that is the largest
LEAST = 0.3  # of the voltage at steady speed, what is back-EMF of a motor
FAR = 4.0  # e-folds of a size, beyond which it is nothing or all
WEAKER = 3.0  # how much less a current drives that rises for L/R of a period
LAGS, VOLTS = ("ln_a1", "ln_a2"), ("vc_plus", "vc_minus", "load")
ALLOWED = {"size": (np.log1p(WEAKER * 1e-3), np.log1p(WEAKER * 1e4))}
ALLOWED |= dict.fromkeys(("share", *VOLTS[:2], "delay"), (0.0, np.inf)) | {"diodes": (0.0, 3.0)}
SHORTEST = 1e-9  # s, of a window
DIFFERENCE = 1e-5  # of each parameter's scale, over which a derivative is taken
STEPS, LONGEST = 40, 100  # of a descent at most, and of the best
CLOSE = 0.01  # of the deviance, which a step gains where a descent ends
SETTLED = 3  # turns of initial states and the voltage of other data
SECOND = (0.02, 0.2)  # second lags that are tried, of the first
LATE = 0.3  # samples of delay, the same


@dataclass(frozen=True, eq=False)
class Joint:
    """A motor and its driver, fitted together."""

    fit: Fit  # the motor, under the voltage of the driver
    driver: Driver
    numbers: tuple[str, ...]  # of the driver that were sought
    std: float  # of the first of them
    voltage: Array  # by sections of the command [V]
    # shape (12,) each: how much less is known of the motor than under a voltage that is known
    moves: tuple[Array, ...]

    @property
    def cost(self) -> float:
        """The deviance with a price for each number."""
        numbers = self.fit.structure.size + len(self.numbers)
        return self.fit.deviance + POLICY.price(1, self.fit.samples) * numbers


def fitted(
    data: Experiments,
    near: Fit,
    driver: Driver,
    options: Options,
    sizes: Sequence[float],
    most: float = math.inf,
) -> Joint | None:
    """Return a motor behind a driver from a fit that knows of none.

    The first order is sought from motors that are regressed on what drivers of some ``sizes`` would
    put out, until two descents end alike; from its answer what is richer, if a score says that it
    may show.  Of a driver that drives all the time and leaves no more than ``most`` deviance, a
    motor without viscous friction is tried, too, and one of the structure of the fit.
    """
    first = near.structure.with_(delay=False, load=False, shift=0.0)
    first = FirstOrder.like(first, friction="symmetric")
    problem = _Problem(data, replace(near, structure=first, initial=data.initial), driver)
    if (found := problem.sought(sizes)) is None:
        return None
    joints = [problem.joint(found, options), _richer(problem, found, near, options)]
    best = _cheapest(joints)
    if best is None or driver.kind in COASTING or best.fit.deviance > most:
        return best
    best = _cheapest([best, continued(data, best.fit, best.driver, options, ("size",))])
    return _cheapest([best, _like(near, best, data, options)]) if best else None


def _cheapest(joints: Sequence[Joint | None]) -> Joint | None:
    return min((j for j in joints if j), key=lambda j: j.cost, default=None)


def _richer(
    problem: _Problem, found: optimize.OptimizeResult, near: Fit, options: Options
) -> Joint | None:
    """Return the motor with a delay or a second lag, if the score of one says that it may show."""
    data, first = problem.data, problem.structure
    z, initial, driver = problem.unpacked(found.x)
    second, lag = SecondOrder.like(first), z.time_constant
    begins: list[tuple[Structure, Coordinates]] = [
        (first.with_(delay=True), z.with_(delay=LATE * data.step)),
        *((second, z.with_second_lag(s * lag)) for s in SECOND),
    ]
    most, more = 0.5 * float(np.log(data.size)), None
    for structure, z in begins:
        other = _Problem(data, replace(near, structure=structure, initial=initial), driver)
        p = other.start(z, driver)
        if (score := problem.score(found, other.misses(p))) > most:
            more, most = (other, p), score
    return more and more[0].joint(more[0].descend(more[1]), options)


def _like(near: Fit, joint: Joint, data: Experiments, options: Options) -> Joint | None:
    """Return the motor with all that was found without its driver, if that is more."""
    if near.structure.current or near.structure.size <= joint.fit.structure.size:
        return None
    z = near.z.with_(ln_a0=joint.fit.z.ln_a0, ln_a1=joint.fit.z.ln_a1)
    z = near.structure.complete(z.with_friction(joint.fit.z.vc_plus))
    there = replace(near, z=z, initial=joint.fit.initial)
    return continued(data, there, joint.driver, options, joint.numbers)


def continued(
    data: Experiments, fit: Fit, driver: Driver, options: Options, numbers: tuple[str, ...]
) -> Joint | None:
    """Return where the descent leads from a motor and its driver, in other data, too.

    Without the ``share`` among its numbers all of the voltage at steady speed is back-EMF.
    """
    driver = driver if "share" in numbers else driver._replace(emf_share=1.0)
    problem = _Problem(data, replace(fit, initial=initial_of(data, fit)), driver, numbers)
    return problem.joint(problem.descend(problem.start(fit.z, driver)), options)


def voltage_of(data: Experiments, fit: Fit, driver: Driver) -> Array:
    """Return what a driver puts out in other data of the motor, by sections [V]."""
    voltage = data.hold_value
    for _ in range(SETTLED):
        there = prediction.settle(replace(data, hold_value=voltage), fit)
        voltage = terminal_voltages(data, fit.structure, fit.z, there.initial, driver)
    return voltage


def rows_of(data: Experiments, voltage: Array) -> Array:
    """Return the voltage of each row of one for each section [V]."""
    if data.how != "after":
        return voltage
    last = np.zeros(data.size, dtype=np.bool_)
    last[data.starts[1:] - 1] = True  # a section has the command of the row before it
    return np.where(last, data.voltage, np.roll(voltage, -1))


def _section_speeds(data: Experiments, lag: float) -> Array:
    """Return the measured speed at the middle of each section of the command."""
    speed, out = measured_speed(data, lag), np.empty(data.hold_end.size)
    sections = pairwise([*data.hold_start[: len(data.starts) - 1].tolist(), data.hold_end.size])
    for (a, b), (i, j) in zip(pairwise(data.starts), sections, strict=True):
        end = data.hold_end[i:j]  # the time of each record is its own
        out[i:j] = np.interp(end - 0.5 * np.diff(end, prepend=end[0]), data.time[a:b], speed[a:b])
    return out


class _Problem:
    """The errors by the motor's free coordinates, the driver's numbers and the initial states."""

    def __init__(
        self,
        data: Experiments,
        near: Fit,
        driver: Driver,
        numbers: tuple[str, ...] = ("size", "share"),
    ) -> None:
        self.data, self.near, self.driver = data, near, driver
        self.structure = near.structure
        self.own = list(own_columns(data, near.structure))
        self.numbers = ("share",) if driver.kind == FREE else numbers
        self.coasts = driver.kind == COAST
        self.names = (*near.structure.free, *self.numbers)
        self.there = np.isfinite(data.output)
        segments = len(data.starts) - 1
        self.owner = np.repeat(np.arange(segments), np.diff(data.starts))[self.there]
        self.weight = 1 / np.sqrt(near.noise[0, 0])
        self.last: tuple[Array, Array] = np.zeros(0), np.zeros(0)

    def starts(self, sizes: Sequence[float]) -> list[Array]:
        """Return parameters to begin with, the likeliest first.

        What a driver would put out at the measured speed is a known voltage, to which a motor's
        equation of motion is linear: drivers of several numbers are tried.
        """
        data, full, found = self.data, self.driver.full_duty, list[Array]()
        first = np.zeros(data.hold_end.size, dtype=np.bool_)
        first[data.hold_start[: len(data.starts) - 1]] = True
        for cutoff in cutoffs(data, BANDS):
            speed = _section_speeds(data, BANDS / cutoff)
            fastest = float(np.quantile(np.abs(speed), FASTEST)) or 1.0
            open_ = (data.hold_value == 0) & (np.abs(speed) > MOVES * fastest)
            if self.driver.kind == FREE and np.count_nonzero(open_) < SEEN:
                return []
            for size, back in product(sizes, BACK):
                driver = self.driver._replace(size=size, emf_share=1.0)
                emf = back * full / fastest
                rows = Rows(data.hold_value, emf * speed, data.hold_end, first, 0.0)
                there = replace(data, hold_value=rows.through(driver))
                bands = np.array([cutoff])
                for z in speed_candidates(there, 1, frictions=(True,), bands=bands):
                    share = float(np.clip(emf * z.dc_gain, LEAST, 1.0))
                    found.append(self.start(z, driver._replace(emf_share=share)))
        with np.errstate(all="ignore"):
            ranked = sorted(found, key=self._drift)
        out: list[Array] = []
        for p in ranked:
            if all(self.apart(p, q) for q in out):
                out.append(p)
        return out

    def sought(self, sizes: Sequence[float]) -> optimize.OptimizeResult | None:
        """Return the best of descents from several starts, of which no more end elsewhere."""
        ends: list[optimize.OptimizeResult] = []
        for p in self.starts(sizes)[:BEGUN]:
            ends.append(self.descend(p))
            if any(not self.apart(e.x, ends[-1].x) for e in ends[:-1]):
                break
        best = min(ends, key=lambda r: float(r.cost), default=None)
        return best if best is None or best.status else self.descend(best.x, LONGEST)

    def apart(self, one: Array, other: Array) -> bool:
        """Tell whether the motors or drivers of two differ by more than some e-folds."""
        logarithms = [k for k, n in enumerate(self.names) if n.startswith("ln_") or n == "size"]
        return bool(np.abs(one - other)[logarithms].max() > APART)

    def _drift(self, p: Array) -> float:
        """Return how far a prediction misses; of an angle, how far it drifts in some samples."""
        miss = self._missed(p)
        if self.data.kind == ANGLE:
            miss = (miss[SPAN:] - miss[:-SPAN])[self.owner[SPAN:] == self.owner[:-SPAN]]
        return float(miss @ miss)

    def start(self, z: Coordinates, driver: Driver) -> Array:
        """Return parameters: a motor, its driver, and the initial states.

        While the current is interrupted it drives by as much less as it rises more slowly: by that
        lag, friction and what is lost to it are multiplied, lest all of them follow the size.
        """
        z, initial = self.structure.complete(z), initial_of(self.data, self.near)
        h = float(np.log1p(WEAKER * driver.size)) if self.coasts else 0.0
        there = {n: z.value(n) for n in self.structure.free}
        there["size"] = h if self.coasts else float(np.log(driver.size))
        there |= {n: there[n] + h for n in LAGS if n in there}
        there |= {n: there[n] * np.exp(h) for n in VOLTS if n in there}
        if "ln_a0" in there:
            there["ln_a0"] += np.log(driver.emf_share)
        there["share"] = (1 / driver.emf_share - 1) * np.exp(h)
        there["diodes"] = driver.diode_drop
        return np.array([*(there[n] for n in self.names), *initial[:, self.own].ravel()])

    def unpacked(self, p: Array) -> tuple[Coordinates, Array, Driver]:
        """Return the motor, its initial states, and its driver."""
        there, k = dict(zip(self.names, map(float, p))), len(self.names)
        logarithm = there.pop("size", 0.0)
        h = logarithm if self.coasts else 0.0
        diodes = there.pop("diodes", self.driver.diode_drop)
        own = there.pop("share", 1 / self.driver.emf_share - 1)
        share = 1 / (1 + own * float(np.exp(-h)))
        there |= {n: there[n] - h for n in LAGS if n in there}
        there |= {n: there[n] * float(np.exp(-h)) for n in VOLTS if n in there}
        if "ln_a0" in there:
            there["ln_a0"] -= float(np.log(share))
        initial = initial_of(self.data, self.near)
        initial[:, self.own] = p[k:].reshape(-1, len(self.own))
        z = self.structure.complete(self.near.z.with_(**there))
        size = float(np.expm1(h)) / WEAKER if self.coasts else float(np.exp(logarithm))
        size = share if self.driver.kind == FREE else size
        return z, initial, self.driver._replace(size=size, emf_share=share, diode_drop=diodes)

    def _values(self, p: Array) -> Array:
        """Return the motor's coordinates, and the driver's numbers."""
        z, _, driver = self.unpacked(p)
        own = {"size": driver.size, "share": driver.emf_share, "diodes": driver.diode_drop}
        motor = [z.value(n) for n in self.structure.free]
        return np.array([*motor, *(own[n] for n in self.numbers)])

    def explained(self, before: float, after: float) -> float:
        """Return the deviance between two sums of squares."""
        return float(self.owner.size * np.log(before / max(after, 1e-12 * before)))

    def score(self, found: optimize.OptimizeResult, misses: Array) -> float:
        """Return the deviance that it gains to go on towards other misses, to first order."""
        q, _ = np.linalg.qr(found.jac)
        way = misses - found.fun
        way -= q @ (q.T @ way)
        down, whole = max(-float(way @ found.fun), 0.0), 2 * float(found.cost)
        return self.explained(whole, whole - down**2 / max(float(way @ way), 1e-300))

    def _shown(self, p: Array) -> tuple[Experiments, Array]:
        """Return the data under the driver's voltage, and what a motor shows under it."""
        z, initial, driver = self.unpacked(p)
        voltage = terminal_voltages(self.data, self.structure, z, initial, driver)
        data = replace(self.data, hold_value=voltage)
        there = replace(self.near, structure=self.structure, z=z, initial=initial)
        return data, prediction.once(data, there)[:, 1]

    def misses(self, p: Array) -> Array:
        """Return the errors of what was measured, of unit variance."""
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
        scale = dict.fromkeys((*VOLTS, "diodes"), top)
        scale |= dict.fromkeys(("delay", "window"), self.data.step)
        of_motor = [(np.array([j]), scale.get(n, 1.0)) for j, n in enumerate(self.names)]
        states, every = (top, fastest, fastest * lag, top), len(self.own)
        segment = every * np.arange(len(self.data.starts) - 1) + len(self.names)
        return of_motor + [(segment + j, states[own]) for j, own in enumerate(self.own)]

    def _slopes(self, p: Array) -> Array:
        here = self.misses(p)
        out = np.zeros((here.size, p.size))
        rows = np.arange(here.size)
        for k, (moved, scale) in enumerate(self._groups):
            there = p.copy()
            there[moved] += DIFFERENCE * scale
            slope = (self._missed(there) - here) / (DIFFERENCE * scale)
            out[rows, k if k < len(self.names) else moved[self.owner]] = slope
        return out

    def descend(self, p: Array, steps: int = STEPS) -> optimize.OptimizeResult:
        """Return where the steps from there lead."""
        low, high = np.full(p.size, -np.inf), np.full(p.size, np.inf)
        for j, name in enumerate(self.names):
            low[j], high[j] = ALLOWED.get(name, (-np.inf, np.inf))
            if name == "size" and not self.coasts:  # without an end it would be nothing
                low[j], high[j] = p[j] - FAR, p[j] + FAR
            if name == "window":
                low[j] = SHORTEST
            if name == "ln_a2":  # a shorter second lag shows in nothing, and friction chatters
                low[j] = p[self.names.index("ln_a1")] + np.log(SHORTEST_LAG * self.data.step)
        inside = np.nextafter(low, high), np.nextafter(high, low)
        with np.errstate(all="ignore"):  # what runs away has a cost that says so
            found: optimize.OptimizeResult = optimize.least_squares(  # type: ignore[operator]
                self.misses, np.clip(p, *inside), self._slopes, (low, high),
                x_scale="jac", max_nfev=steps, ftol=CLOSE / self.data.size,
            )  # fmt: skip
        return found

    def joint(self, found: optimize.OptimizeResult, options: Options) -> Joint | None:
        """Return what is found and what is known of it; None where it ran away, or is no motor."""
        z, initial, driver = self.unpacked(found.x)
        data = self._shown(found.x)[0]
        fit = solve(data, self.structure, self.near.at(z, initial, 0.0), options)
        if not np.isfinite(fit.deviance) or driver.emf_share < LEAST:
            return None
        slopes, k = found.jac, len(self.names)
        variance = 2 * found.cost / max(slopes.shape[0] - slopes.shape[1], 1)
        variance *= sandwich_factor(fit)
        moved = np.eye(k, slopes.shape[1]) * DIFFERENCE
        turn = np.array([self._values(found.x + m) - self._values(found.x - m) for m in moved])
        turn /= 2 * DIFFERENCE
        inverse = prediction.inverse(slopes.T @ slopes)[:k, :k]
        together = variance * turn.T @ inverse @ turn
        k = len(self.structure.free)
        std = float(np.sqrt(together[k, k]))
        known = sandwich_factor(fit) * fit.white()
        moves = [fit.structure.matrix @ m for m in _beyond(together[:k, :k], known)]
        return Joint(fit, driver, self.numbers, std, data.hold_value, tuple(moves))


def _beyond(whole: Array, part: Array) -> list[Array]:
    """Return moves whose outer products add up to what a covariance has beyond another."""
    scale = np.sqrt(np.maximum(np.diag(whole), np.diag(part)))
    values, vectors = np.linalg.eigh((whole - part) / np.outer(scale, scale))
    return [np.sqrt(v) * scale * x for v, x in zip(values, vectors.T, strict=True) if v > 0]
