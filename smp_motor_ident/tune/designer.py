# SPDX-License-Identifier: Apache-2.0
"""Design gains from an estimate and a loop, with their margins and the reason, by any method.

Methods work at the motor shaft; the gains that come out are per wheel rad/s.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from smp_motor_control.pid import PidGains
from smp_motor_ident.errors import DesignError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import (
    MAX_DELAY_SHARE,
    MAX_SETTLING_LOSS,
    MIN_LIMITING_SHARE,
    SETTLING_BAND,
)
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.case import COMMON_TARGETS, Case, Robustness, prepare, solve
from smp_motor_ident.tune.feedback import Feedback, Margins, loop_margins
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.methods import METHODS
from smp_motor_ident.tune.motors import Motors, move_lag_to_sensor
from smp_motor_ident.tune.plant import Plant, sample
from smp_motor_ident.tune.reference import Reference, controller_for, plan_reference
from smp_motor_ident.tune.simulation import Controller
from smp_motor_ident.tune.specification import Performance, Settling, Specification, compute_figures
from smp_motor_ident.tune.unmodelled import describe_known_band


@dataclass(frozen=True)
class Design:
    """Gains for one wheel, their margins and the reason for them."""

    gains: PidGains  # of the running controller, per wheel rad/s
    margins: Margins  # of the nominal sampled loop
    reason: str  # in words for the user
    method: str  # name of it
    loop: Loop  # that it was designed for
    robustness: Robustness  # over the distribution of the estimate
    performance: Performance  # of the simulated loop
    specification: Specification  # bands over the distribution
    reference: Reference  # limits and duration of set-point changes, at the motor shaft
    plant: Plant  # the sampled motor in its loop
    motor: dict[str, float]  # combinations that it was designed from, at the motor shaft
    sensor: dict[str, float]  # averaging and lag of the reported speed, as identified [s]
    wheel: str = ""  # whose gains these are
    findings: tuple[Finding, ...] = ()  # warnings for the user
    feedback: Feedback = field(default_factory=lambda: Feedback(0.0, 0.0))
    breakaway: float = 0.0  # command at which the motor must turn [V]
    together: bool = False  # whether its reference is common to several wheels

    @property
    def wheel_reference(self) -> Reference:
        """The reference at the wheel."""
        return self.reference.at_wheel(self.loop.gear_ratio)

    @property
    def settling(self) -> Settling:
        """Settling of a change of set-point, and its parts."""
        bands = self.specification
        return Settling(
            value=bands.settling.value,
            high=bands.settling.high,
            tolerance=SETTLING_BAND,
            change=bands.change / self.loop.gear_ratio,
            transition=self.reference.duration(bands.change, self.loop.sample_time),
            common=self.together,
            abrupt=self.performance.step_settling,
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """The findings in words."""
        return tuple(one.message for one in self.findings)


def design(estimate: Estimate, loop: Loop, method: str = "margin", **targets: Any) -> Design:
    """Design the speed controller of one motor for the loop that will run.

    Parameters
    ----------
    estimate : Estimate
        Combinations suffice: ``dc_gain``, ``time_constant``, ``time_constant_product``, ``delay``,
        ``static_voltage``.
    loop : Loop
        Sampling, delay, encoder, gearbox, supply.
    method : str
        One of :data:`METHODS`.
    **targets
        Targets of the method, such as ``phase_margin`` [deg] or ``bandwidth`` [rad/s], and
        for all methods: ``max_velocity`` [rad/s, wheel], ``max_acceleration`` [rad/s^2, wheel],
        ``transition_time`` [s], ``together`` (one of several motors that shall arrive together),
        ``samples`` (draws of the distribution), ``seed``,
        ``accept_unreliable`` (design on an unreliable estimate, with a wider distribution).

    Returns
    -------
    Design

    Raises
    ------
    DesignError
        When the demand cannot be met, with the limit and the nearest design, or the estimate is
        unreliable and ``accept_unreliable`` is not given.
    """
    case = prepare(estimate, loop, method, targets)
    return finish(case, *solve(case))


def finish(
    case: Case,
    feedback: Feedback,
    factor: float,
    robustness: Robustness,
    lead: Reference | None = None,
) -> Design:
    """Add feed-forward, reference, figures and words to gains scaled by ``factor``.

    The reference is that of ``lead``, if given, or as slow as these gains need.
    """
    problem, plant, loop = case.problem, case.problem.plant, case.problem.loop
    controller = controller_for(loop, feedback)
    margins = loop_margins(plant, feedback)
    quickest = _plan_change(case, controller, margins)
    simulated = _simulate_with(case, controller, margins)
    if lead is None:
        free = "transition_time" not in problem.targets
        reference, figures, bands = _select_reference(quickest, simulated, free)
    else:
        slower = max(lead.transition_time, quickest.transition_time)
        reference = replace(lead, transition_time=slower)
        figures, bands = simulated(reference)
    reason, findings = _explain(case, margins, factor, robustness, (figures, bands))
    m = plant.motors
    return Design(
        gains=convert_gains(case, controller),
        margins=margins,
        reason=reason,
        method=case.method.name,
        loop=loop,
        robustness=robustness,
        performance=figures,
        specification=bands,
        reference=reference,
        plant=plant,
        motor={**m.combine(), "static_voltage": case.friction.known},
        sensor={
            "averaging_window": float(m.averaging_window[0]),
            "sensor_lag": float(m.sensor_lag[0]),
        },
        wheel=case.wheel,
        findings=findings,
        feedback=feedback,
        breakaway=case.breakaway,
        together=bool(problem.targets.get("together")),
    )


def settles(case: Case, feedback: Feedback) -> bool:
    """Return whether a largest settling time can be stated for the quickest change."""
    controller = controller_for(case.problem.loop, feedback)
    margins = loop_margins(case.problem.plant, feedback)
    quickest = _plan_change(case, controller, margins)
    return math.isfinite(_simulate_with(case, controller, margins)(quickest)[1].settling.high)


def _simulate_with(
    case: Case, controller: Controller, margins: Margins
) -> Callable[[Reference], tuple[Performance, Specification]]:
    """Return the simulated figures of a change of set-point."""
    usual, feedback = _sample_usual(case), controller.feedback
    noise, found = case.problem.control_noise(feedback), case.ensemble.margins(feedback)
    return lambda plan: compute_figures(case, usual, controller, plan, (margins, found), noise)


def with_reference(case: Case, one: Design, reference: Reference) -> Design:
    """Return a design with another reference, and the figures that go with it."""
    controller = controller_for(one.loop, one.feedback)
    figures, bands = _simulate_with(case, controller, one.margins)(reference)
    return replace(one, reference=reference, performance=figures, specification=bands)


def _sample_usual(case: Case, motors: Motors | None = None) -> Plant:
    """Return the nominal motor, or another in its place, sampled with the loop's usual delay."""
    loop, nominal = case.problem.loop, case.problem.plant.motors
    expected = replace(loop, delay=loop.expected_delay)
    return sample(motors or nominal, expected, believed=nominal)


def convert_gains(case: Case, controller: Controller) -> PidGains:
    """Return the running controller's settings, per wheel rad/s."""
    loop, m = case.problem.loop, case.problem.plant.motors
    ratio, fb = loop.gear_ratio, controller.feedback
    tracking = controller.tracking
    limit = loop.supply_voltage
    return PidGains(
        p=fb.p * ratio,
        i=fb.i * ratio,
        d=fb.d * ratio,
        u_clamp_min=-limit,
        u_clamp_max=limit,
        i_clamp_min=-limit,
        i_clamp_max=limit,
        antiwindup_strategy="back_calculation" if math.isfinite(tracking) else "none",
        tracking_time_constant=tracking if math.isfinite(tracking) else 0.0,
        setpoint_weight_p=controller.weight,
        setpoint_weight_d=controller.weight_d,
        derivative_filter_time_constant=fb.filter_time,
        feedforward_static=case.lost_voltage,
        feedforward_velocity=float(m.a0[0]) * ratio,
        feedforward_acceleration=float(m.a1[0]) * ratio,
    )


def _plan_change(case: Case, controller: Controller, margins: Margins) -> Reference:
    loop, usual = case.problem.loop, _sample_usual(case)
    plants = [usual]
    if case.lag_in_doubt:
        plants.append(_sample_usual(case, move_lag_to_sensor(usual.motors)))
    # The doubt on the delay is at most the share that the margins bear.
    doubt = max(loop.delay_doubt, case.scatter)
    borne = replace(loop, delay_doubt=min(doubt, MAX_DELAY_SHARE * margins.delay))
    least = 0.4 / margins.crossover if margins.crossover > 0 else 0.0
    drive = max(case.driver.drive - case.friction.planned, 0.1 * case.driver.drive)
    return plan_reference(
        plants, borne, controller, case.problem.targets, least, drive, case.driver.slew
    )


def _select_reference(
    quickest: Reference,
    figures: Callable[[Reference], tuple[Performance, Specification]],
    free: bool,
) -> tuple[Reference, Performance, Specification]:
    """Return the reference with the least stated settling time, and its figures.

    Quick changes excite unmodelled dynamics most: they settle no sooner than slower ones, and
    overshoot more.  Of the references with nearly the least settling time, the one with the least
    stated overshoot is chosen.
    """
    tried = [(quickest, *figures(quickest))]
    most = (1 + MAX_SETTLING_LOSS) * tried[0][2].settling.high  # NaN: nothing is tried
    while free and 2 * tried[-1][0].transition_time < most:
        plan = replace(quickest, transition_time=2 * tried[-1][0].transition_time)
        tried.append((plan, *figures(plan)))
        most = min(most, (1 + MAX_SETTLING_LOSS) * tried[-1][2].settling.high)
    good = [one for one in tried if one[2].settling.high <= most] or tried[:1]
    return min(good, key=lambda one: one[2].overshoot.high)


def _explain(
    case: Case, margins: Margins, factor: float, robustness: Robustness,
    simulated: tuple[Performance, Specification],
) -> tuple[str, tuple[Finding, ...]]:  # fmt: skip
    loop, (figures, bands) = case.problem.loop, simulated
    words = [
        f"{case.method.title} at {loop.rate:g} Hz with {1e3 * loop.loop_delay:.3g} ms of delay"
        f"{_describe_sensor(case)}: phase margin {margins.phase:.0f} deg, "
        f"Ms {margins.sensitivity:.2f}, crossover {margins.crossover:.3g} rad/s"
    ]
    findings = list(case.findings)
    if case.drawn:
        words.append(
            f"{100 * robustness.holds:.1f} % of {robustness.samples} motors within the uncertainty "
            f"keep the required margins, {100 * robustness.stable:.1f} % are stable"
        )
    if factor < 1:
        words.append(
            f"gains reduced to {100 * factor:.0f} % of the rule's, so that 99 % of these motors "
            "keep the margins, and the control noise its limit"
        )
    unmodelled = case.problem.unmodelled
    if unmodelled is not None:
        words.append(
            f"unmodelled dynamics reach {100 * robustness.unmodelled:.0f} % of the loop's bound"
            + describe_known_band(unmodelled, ": ")
        )
        # Beyond the crossover |T| is proportional to the gains, which the factor has reduced.
        if robustness.unmodelled > MIN_LIMITING_SHARE * min(factor, 1.0):
            findings.append(Finding(
                "unmodelled_dynamics", "warning",
                "the gains are limited because the motor's response is known only up to "
                f"{unmodelled.known:.3g} rad/s",
                {"known_frequency": unmodelled.known},
                "for larger gains record a voltage that changes faster, such as a pseudo-random "
                "binary one",
            ))  # fmt: skip
    if figures.control_noise > 1.05 * loop.noise_limit:
        noisy = (
            f"measurement noise causes {figures.control_noise:.2g} V of control noise, and "
            f"{loop.noise_limit:.2g} V are desired: the motor gets warmer and louder"
        )
        findings.append(Finding("control_noise", "warning", noisy))
    if math.isnan(bands.settling.high):
        open_end = (
            "some motors within the uncertainty do not settle within 2 % of a change of set-point, "
            "so no largest settling time is stated"
        )
        findings.append(Finding("settling_unknown", "warning", open_end))
    return "; ".join(words), tuple(findings)


def _describe_sensor(case: Case) -> str:
    """Return averaging and lag of the reported speed in words."""
    plant, words = case.problem.plant, ""
    if case.problem.loop.reports_speed and plant.motors.averaging_window[0] > 0 and plant.window:
        words += f", a speed averaged over {1e3 / plant.average[0, 0]:.3g} ms"
    if plant.motors.sensor_lag[0] > 0:
        words += f", a sensor lag of {1e3 * plant.motors.sensor_lag[0]:.3g} ms"
    return words


def compare(estimate: Estimate, loop: Loop, **targets: Any) -> dict[str, Design | DesignError]:
    """Return each method's design, with the targets that it understands, or its error."""
    results: dict[str, Design | DesignError] = {}
    for name in METHODS:
        known = (*COMMON_TARGETS, *METHODS[name].targets)
        own = {key: value for key, value in targets.items() if key in known}
        try:
            results[name] = design(estimate, loop, name, **own)
        except DesignError as error:
            results[name] = error
    return results


def recommend(results: dict[str, Design | DesignError]) -> tuple[str, str]:
    """Return the best result of :func:`compare`, with the reason; DesignError if none is valid."""
    sound = {
        name: r
        for name, r in results.items()
        if isinstance(r, Design)
        and r.margins.stable
        and r.margins.sensitivity <= 1.6
        and r.performance.control_noise <= 1.05 * r.loop.noise_limit
        and math.isfinite(r.performance.settling)
    }
    if not sound:
        raise DesignError(
            "no method keeps Ms below 1.6 within the control noise that the loop allows"
        )
    name = min(sound, key=lambda n: sound[n].performance.load_integral)
    others = sorted(r.performance.load_integral for n, r in sound.items() if n != name)
    best = sound[name]
    better = f", {others[0] / best.performance.load_integral:.2f} times the next" if others else ""
    return name, (
        f"{METHODS[name].title}: of the methods that keep Ms below 1.6 and the control noise below "
        f"{best.loop.noise_limit:.2g} V it rejects a load best{better}, with a phase margin of "
        f"{best.margins.phase:.0f} deg"
    )
