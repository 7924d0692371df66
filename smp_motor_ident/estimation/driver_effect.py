"""A driver's effect on its command, found or declared: what it means for a motor's estimate.

What follows sees the voltage at the terminals in place of the command.
Derivation: docs/derivations.md, section 13.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import HALF_EXPLAINED
from smp_motor_ident.diagnosis.sample_limits import (
    DRIVER_TOLERANCE,
    EFFECT_SHOWN,
    ORDINARY_BEND,
    SLEW_SEEN,
)
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.selection import FittedCandidate, bic, evidence
from smp_motor_ident.finding import Finding, Severity
from smp_motor_ident.likelihood.experiments import Experiments, output_of
from smp_motor_ident.model.coordinates import place
from smp_motor_ident.model.driver import (
    CLIP,
    COAST,
    DEAD_ZONE,
    DECLARABLE,
    DRAG,
    DROP,
    EFFECTS,
    SAG,
    SLEW,
    Driver,
    DriverEffect,
    Rows,
)
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.record import Record
from smp_motor_ident.result import NORMAL_95, UNITS, Estimate, Quantity

FRICTION = place("vc_plus")


class Search(Protocol):
    """What found a driver, and knows how it follows other records."""

    data: Experiments  # what the motor behind it was fitted to

    @property
    def numbers(self) -> int:
        """How many numbers of the driver were sought."""
        ...

    def on(self, group: list[Record], most: float, behind: float) -> DriverFit | None:
        """Return what is found with more records."""
        ...

    def moves(self, fit: Fit) -> list[Array]:
        """Return how a motor moves by what is not known of its driver, shape (12,) each."""
        ...

    def applied(self, records: Sequence[Record], fit: Fit) -> list[Record]:
        """Return other records of the motor with the voltage at the terminals."""
        ...


@dataclass(frozen=True, eq=False)
class DriverFit:
    """An effect of known size, and the records with the voltage at the terminals."""

    effect: DriverEffect
    driver: Driver
    std: float  # of its size
    before: list[Record]  # as they were
    records: list[Record]
    search: Search  # what found it
    fit: Fit  # the motor behind it, roughly
    # the same of other effects that explain the records as well
    rivals: tuple[Fit, ...] = ()
    as_likely: tuple[FittedCandidate, ...] = ()  # if the records do not decide about it

    def cost(self, price: float, factor: float) -> float:
        """Return the deviance over a sandwich factor, with a price for each number."""
        return self.fit.deviance / factor + price * (self.fit.structure.size + self.search.numbers)

    @property
    def tolerance(self) -> float:
        """By how much its size is another in another record."""
        return DRIVER_TOLERANCE.value * self.driver.size if self.effect.follows_motion else 0.0

    @property
    def shown(self) -> bool:
        """Whether its 95 % interval holds nothing that is no effect, nor is over between rows.

        A dead zone or a drop that is no larger than what every drive has is friction's.
        """
        size, kind = self.driver.size, self.effect.kind
        if kind == COAST:  # of which the size may be anything, as long as it coasts
            return True
        top = max(float(np.abs(r.voltage).max()) for r in self.before)
        if kind == CLIP:
            size = top - size
        if kind in (DEAD_ZONE, DROP) and size < ORDINARY_BEND.value * top:
            return False
        if kind == SLEW:
            rise = max(float(np.abs(np.diff(r.voltage)).max()) for r in self.before) / size
            if rise < SLEW_SEEN.value * min(r.sample_time for r in self.before):
                return False
        return self.std < EFFECT_SHOWN.value * size

    def beyond_chance(self, plain: Fit, price: float) -> bool:
        """Tell whether errors of few steady speeds, or of few changes, hardly look like it."""
        bent = ("ln_a1",) if self.effect.kind == SLEW else ("ln_a0", "vc_plus")
        both = set(plain.structure.free) & set(self.fit.structure.free)
        least = min((evidence(plain, self.fit, c) for c in bent if c in both), default=math.inf)
        return least > price * self.search.numbers

    def widened(self, fit: Fit, friction_std: float) -> tuple[Fit, float]:
        """Return a fit with its covariance widened by what is not known of the driver.

        And so the standard deviation of a friction [V] that it leaves out.
        """
        moves = self.search.moves(fit)
        moves += [rival.z.array - self.fit.z.array for rival in self.rivals]
        for move in moves:
            fit = fit.along(fit.structure.of_free(move))
        if fit.structure.friction == "none":
            friction_std = math.hypot(friction_std, *(move[FRICTION] for move in moves))
        return fit, friction_std


def through(estimate: Estimate, found: DriverFit) -> Estimate:
    """Return the estimate of a motor behind a driver, with what is known of the driver."""
    size, std = found.driver.size, math.hypot(found.std, found.tolerance)
    interval = max(size - NORMAL_95 * std, 0.0), size + NORMAL_95 * std
    unit = UNITS[found.effect.quantity]
    words = f"the records show {found.effect.cause}: {size:.3g} ± {std:.2g}"
    words += f" {unit}" if unit != "1" else ""
    quantity = Quantity(size, std, interval, unit)
    supply = [r.hardware.supply_voltage for r in found.before]
    if all(supply) or found.effect.kind not in (COAST, SAG):
        return _behind(estimate, found.effect, quantity, words, found.driver)
    words += f", were it always on at {found.driver.full_duty:.3g} V, the largest command"
    # The motor itself is of another gain behind one that coasts for another part of its periods.
    severity: Severity = "unreliable" if found.effect.kind == COAST else "warning"
    return _behind(estimate, found.effect, quantity, words, found.driver, severity)


def suspecting(estimate: Estimate, found: DriverFit | None, fit: Fit) -> Estimate:
    """Return an estimate, unreliable for a driver that explains most of what it does not itself."""
    if found is None or found.as_likely:
        return estimate
    left = math.exp((found.fit.deviance - fit.deviance) / fit.samples)
    codes = {f.code for f in estimate.findings if f.severity != "note"}
    if left > HALF_EXPLAINED.value or found.effect.code in codes:
        return estimate
    words = (
        f"{found.effect.cause} would explain {1 - left:.0%} of the error, but the motor behind it "
        "does not hold either"
    )
    advice = "record the voltage at the motor's terminals, or set the driver to follow its command"
    finding = Finding(found.effect.code, "unreliable", words, {"explains": 1 - left}, advice)
    return replace(estimate, findings=(finding, *estimate.findings))


def shows_another(estimate: Estimate, found: DriverFit) -> bool:
    """Tell whether the error of a motor behind a driver shows that another does more than that."""
    others = {effect.code for effect in EFFECTS if effect.kind != DRAG} - {found.effect.code}
    return any(
        f.code in others and f.severity == "warning" and "shift_std" in f.evidence
        for f in estimate.findings
    )


def suspects_driver(estimate: Estimate) -> bool:
    """Tell whether an estimate is unreliable for what a driver may do."""
    codes = {effect.code for effect in EFFECTS}
    return any(f.severity == "unreliable" and f.code in codes for f in estimate.findings)


def leaves_torque_noise(estimate: Estimate, fit: Fit) -> bool:
    """Tell whether a motor behind a driver needs most of the torque noise of one without it.

    That would stand for what the driver does not explain.
    """
    intensity = [f.evidence["intensity"] for f in estimate.findings if f.code == "torque_noise"]
    most = HALF_EXPLAINED.value * fit.noise_ratio
    return any(isinstance(left, float) and left > most for left in intensity)


def leaves_most(plain: Estimate, other: Estimate) -> bool:
    """Tell whether another estimate, as behind a driver, explains most of the error of one."""
    left, more = (100.0 - (e.fit_percent.estimation or 0.0) for e in (plain, other))
    return more**2 < HALF_EXPLAINED.value * left**2


def explains_no_more(estimate: Estimate, fit: Fit) -> bool:
    """Tell whether a motor behind a driver, under torque noise, is no likelier than one without.

    Both have a torque noise of their own then, and only the price of the driver's number between.
    """
    noisy = any(f.code == "torque_noise" for f in estimate.findings)
    behind = next(c.bic for c in estimate.candidates if c.chosen)
    return fit.noise_ratio > 0 and noisy and behind is not None and behind >= bic(fit)


def declared(
    estimate: Callable[[list[Record], Sequence[Record] | None], Estimate],
    group: list[Record],
    validation: Sequence[Record] | None,
    known: Mapping[str, float],
) -> Estimate:
    """Return the estimate of a motor behind a driver of which the user says what it does."""
    there = [(e, float(known[name])) for name, e in DECLARABLE.items() if name in known]
    drivers = []
    for effect, size in there:
        driver = Driver(effect.kind, size, max(float(np.abs(r.voltage).max()) for r in group))
        drivers.append(driver)
        group = [_driven(r, driver) for r in group]
        validation = validation and [_driven(r, driver) for r in validation]
    found = estimate(group, validation)
    for (effect, size), driver in zip(there, drivers, strict=True):
        unit = UNITS[effect.quantity]
        words = f"as declared, there is {effect.cause}: {size:.3g} {unit}"
        quantity = Quantity(size, unit=unit, status="fixed")
        found = _behind(found, effect, quantity, words, driver)
    return found


def _driven(record: Record, driver: Driver) -> Record:
    """Return a record with the voltage that a driver makes of its command."""
    first = np.zeros(len(record), dtype=np.bool_)
    first[list(record.starts)] = True
    interval = np.diff(record.time, prepend=record.time[0])
    output, kind, _ = output_of(record)
    speed = np.gradient(output, record.time) if kind == ANGLE else output
    most, top = float(np.nanmax(np.abs(speed), initial=0.0)) or 1.0, np.abs(record.voltage).max()
    rows = Rows(record.voltage, speed * top / most, interval, first, 0.0)
    return replace(record, voltage=rows.through(driver))


def _behind(
    estimate: Estimate,
    effect: DriverEffect,
    quantity: Quantity,
    words: str,
    driver: Driver,
    unknown_supply: Severity | None = None,
) -> Estimate:
    """Return an estimate with a driver, of one of an unknown supply with as severe a finding."""
    fixed = quantity.status == "fixed"
    advice = "record the voltage at the motor's terminals to see it"
    if effect.quantity in DECLARABLE:
        advice += f", or declare it with --fix {effect.quantity}="
    if effect.kind == DRAG:
        advice = "record at the speeds at which the motor will run; look for stiff grease"
    if unknown_supply:
        advice = "state the supply's voltage (supply_voltage=), at which the driver is always on"
    finding = Finding(
        effect.code,
        unknown_supply or ("note" if fixed else "warning"),
        f"{words}; the motor is estimated behind it, and a controller meets both",
        {"quantity": effect.quantity, "std": quantity.std, "size": driver.size,
         "full_duty": driver.full_duty, "emf_share": driver.emf_share,
         "diode_drop": driver.diode_drop},
        "" if fixed else advice,
    )  # fmt: skip
    combinations = {**estimate.combinations, effect.quantity: quantity}
    return replace(estimate, combinations=combinations, findings=(finding, *estimate.findings))


def driver_of(estimate: Estimate) -> Driver:
    """Return the driver behind which a motor was estimated."""
    for effect in EFFECTS:
        for finding in estimate.findings:
            numbers = [finding.evidence.get(n) for n in ("size", "full_duty", "emf_share")]
            known = [n for n in numbers if isinstance(n, float)]
            same = finding.evidence.get("quantity", effect.quantity) == effect.quantity
            if finding.code == effect.code and same and len(known) == len(numbers):
                diodes = estimate.evidence(effect.code, "diode_drop")
                return Driver(effect.kind, *known)._replace(diode_drop=diodes)
    return Driver()
