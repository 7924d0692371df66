"""Estimates beside what no motor does: a driver, a drag, a load that steps, an accident."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from smp_motor_ident.diagnosis.adequacy import is_moved, lacks_something
from smp_motor_ident.diagnosis.left_out import Tried, under_own_loads, undisturbed
from smp_motor_ident.diagnosis.noise_or_effect import instead_of_drag
from smp_motor_ident.diagnosis.one_size import one_size_of_voltage, one_size_or_swing
from smp_motor_ident.diagnosis.repair import hides_driver
from smp_motor_ident.diagnosis.scope import blames_current
from smp_motor_ident.diagnosis.systematic import of_one_size
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.driver_effect import (
    DriverFit,
    explains_no_more,
    leaves_most,
    leaves_torque_noise,
    shows_another,
    through,
)
from smp_motor_ident.estimation.driver_search import likeliest, run_free
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.request import Request
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.driver import (
    AT_ONE_LEVEL,
    AT_ONE_SIZE,
    DRAGS,
    EFFECTS,
    RAMPS,
    DriverEffect,
)
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate


@dataclass(frozen=True, eq=False)
class Alternatives:
    """A fit, what it was fitted to, and the estimates that may take the place of its own."""

    tried: Tried
    group: list[Record]
    request: Request
    found: Sequence[Finding]
    data: Experiments
    hold: str
    fit: Fit

    def beside_model(
        self, plain: Estimate | None, noisy: bool
    ) -> tuple[Estimate | None, DriverFit | None]:
        """Return the estimate beside what no motor does, if one holds, and the likeliest driver.

        What a driver explains without an accident is none, and no step of a load; nor is it the
        step alone where most of what it leaves is a driver's.
        """
        asked = self.tried, self.group, self.request, self.found
        behind, driver = self._through_driver(EFFECTS)
        codes = {f.code for f in behind.findings} if behind else set()
        if behind is not None and not codes & {"disturbed", "load_step"}:
            return behind, driver
        apart = under_own_loads(*asked, self.data, self.fit)
        if apart and not (behind and leaves_most(apart, behind)):
            return apart, None
        if noisy:
            behind = undisturbed(*asked, self.fit, plain) or behind
        return behind, driver

    def instead_of(self, plain: Estimate) -> tuple[Estimate | None, DriverFit | None]:
        """Return the same in place of an estimate; of one that shows nothing, but of its noise."""
        if self.request.suspected or lacks_something(plain):
            return self.beside_model(plain, is_moved(plain) or self.fit.noise_ratio > 0)
        for effects in (RAMPS, DRAGS) if self.fit.noise_ratio > 0 else ():
            behind, _ = self._through_driver(effects)
            if behind is not None:
                return behind, None
        return None, None

    def _through_driver(
        self, effects: Sequence[DriverEffect]
    ) -> tuple[Estimate | None, DriverFit | None]:
        """Return the estimate behind the likeliest driver, if it holds, and that driver.

        A ramp is sought beside torque noise, which stands for none of it.
        """
        group, request, fit = self.group, self.request, self.fit
        one_size = one_size_or_swing(self.data)
        if request.driver is not None or hides_driver(group) or (one_size and effects is RAMPS):
            return None, None
        if one_size:  # which tells of a driver what it does at no command
            effects = AT_ONE_LEVEL if self.data.one_way else AT_ONE_SIZE
        request.say("what the driver makes of its command")
        beside = effects is RAMPS
        start = fit if beside else run_free(group, fit, self.hold, request.options)
        driver = likeliest(group, start, self.hold, request.options, effects)
        if driver is None or driver.as_likely:
            return None, driver
        if driver.effect in DRAGS and effects is not EFFECTS:  # which then stands for no other
            best = likeliest(group, start, self.hold, request.options, EFFECTS)
            if best is None or best.effect not in DRAGS:
                return None, None
        if driver.effect in DRAGS:
            gained, gear = start.deviance - driver.fit.deviance, group[0].hardware.gear_ratio
            rivals = instead_of_drag(of_kind(self.data, start), start, gained, gear)
            if rivals is None:
                return None, None
            driver = replace(driver, rivals=(*driver.rivals, *rivals))
        known = request.validation
        kept = None if known is None else driver.search.applied(known, driver.fit)
        asked = replace(request, driver=driver, validation=kept)
        e = self.tried(driver.records, asked, self.found)
        if e is None:
            return None, driver
        codes = {f.code for f in e.findings}
        emptied = {"implausible_motor", *(() if one_size else ("one_level", "one_size_of_voltage"))}
        hollow = emptied & codes  # little is left of what was recorded
        fails = any(f.severity == "unreliable" and not blames_current(f) for f in e.findings)
        fails = fails or (leaves_torque_noise(e, fit) and not beside) or explains_no_more(e, fit)
        fails = fails or shows_another(e, driver)
        hides = one_size_of_voltage(one_size, of_one_size(group[0].hardware))
        said = *e.findings, *(f for f in hides if f.code not in codes)
        return (None if fails or hollow else through(replace(e, findings=said), driver)), driver
