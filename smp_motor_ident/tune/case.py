# SPDX-License-Identifier: Apache-2.0
"""Solve one motor, loop and method, and reduce the gains if the uncertainty requires it.

Gains are checked for the motors within the uncertainty of the estimate.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from smp_motor_ident.chain.catalogue import rebuild_chain
from smp_motor_ident.chain.terminal import Driver, apply_driver, make_driver
from smp_motor_ident.errors import DesignError
from smp_motor_ident.finding import Finding
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.feedback import (
    BatchMargins,
    Feedback,
    batch_margins,
    make_grid,
    spectral_radius,
)
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.methods import METHODS
from smp_motor_ident.tune.motors import (
    Friction,
    alternate_motors,
    bound_friction,
    compute_outlier_share,
    compute_torque_noise,
    draw_motors,
    make_motors,
    move_lag_to_sensor,
    report_sensor_lag,
    unreliable_spread,
)
from smp_motor_ident.tune.plant import Plant, sample
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins, check_target
from smp_motor_ident.tune.unmodelled import describe_known_band, unmodelled_dynamics

REQUIRED_SHARE = 0.99  # share of the distribution for which the required margins must hold


@dataclass(frozen=True)
class Robustness:
    """Stability and margins over the distribution of the estimate."""

    samples: int  # motors drawn; 0 where the estimate has no uncertainty
    stable: float  # share with a stable loop [0..1]
    holds: float  # share that keeps every required margin [0..1]
    # phase, gain, sensitivity: phase margin [deg], gain margin [-] and Ms [-] of the worst percent
    phase: float
    gain: float
    sensitivity: float
    unmodelled: float = 0.0  # largest |T| W of unmodelled dynamics [-]; stable below 1


class UncertaintyEnsemble:
    """Assessment of gains over a batch of motors, whose response is computed once."""

    def __init__(
        self, plant: Plant, required: RequiredMargins, nominal: Problem | None = None
    ) -> None:
        self.plant = plant
        self.required = required
        self.nominal = nominal  # whose unmodelled dynamics the gains must bear
        self.omega = make_grid(plant, 200)
        self.response = plant.response(self.omega)

    def margins(self, feedback: Feedback) -> BatchMargins:
        """Return the margins of every motor of the batch."""
        loop = self.response * feedback.response(self.omega, self.plant.sample_time)
        return batch_margins(loop, self.omega)

    def assess(self, feedback: Feedback) -> Robustness:
        """Return stability and margins over the batch."""
        m = self.margins(feedback)
        stable = spectral_radius(self.plant, feedback) < 1
        p = self.required
        # A hundredth of slack: the grid's resolution.
        holds = stable & (m.phase >= 0.99 * p.phase) & (m.gain >= 0.99 * p.gain)
        holds &= m.sensitivity <= 1.01 * p.sensitivity
        unmodelled = 0.0 if self.nominal is None else self.nominal.unmodelled_gain(feedback)
        holds &= unmodelled <= 1.01
        low, high = 1 - REQUIRED_SHARE, REQUIRED_SHARE
        return Robustness(
            samples=len(self.plant),
            stable=float(np.mean(stable)),
            holds=float(np.mean(holds)),
            phase=float(np.quantile(m.phase, low, method="lower")),
            gain=float(np.quantile(m.gain, low, method="lower")),
            sensitivity=float(np.quantile(m.sensitivity, high, method="higher")),
            unmodelled=unmodelled,
        )


def back_off(
    assess: Callable[[Feedback], Robustness], feedback: Feedback
) -> tuple[Feedback, float, Robustness]:
    """Scale gains down until 99 % of the motors keep the required margins.

    Proportional and derivative action shrink with the factor, integral action with its square,
    so that the loop keeps its shape while its crossover moves down.
    """

    def attempt(factor: float) -> tuple[Feedback, float, Robustness]:
        trial = reduce_crossover(feedback, factor)
        return trial, factor, assess(trial)

    whole = found = attempt(1.0)
    bad = 1.0
    while found[2].holds < REQUIRED_SHARE:
        bad, factor = found[1], 0.97 if found is whole else found[1] * found[1]
        if factor <= 0.01:
            return feedback, 0.0, whole[2]
        found = attempt(factor)
    for _ in range(6 if found is not whole else 0):
        closer = attempt(0.5 * (found[1] + bad))
        if closer[2].holds >= REQUIRED_SHARE:
            found = closer
        else:
            bad = closer[1]
    return found


def reduce_crossover(feedback: Feedback, factor: float) -> Feedback:
    """Return gains with a lower crossover and the same shape of the loop."""
    return replace(feedback.scaled(factor), i=feedback.i * factor**2)


MAX_CONTROL_NOISE = 1 / 6
"""Largest control noise [share of the supply, rms] of any gains: three standard deviations are half
of the supply, and clamped noise opens the loop."""


WORK, MIN_DRAWS = 5e7, 50
"""Largest product of draws and cubed number of states, and smallest number of draws."""

COMMON_TARGETS = (
    "max_velocity", "max_acceleration", "transition_time", "together", "samples", "seed",
    "accept_unreliable",
)  # fmt: skip
"""Targets of all methods."""


@dataclass(frozen=True)
class Case:
    """One motor, one loop and one method, prepared to judge and to finish a design."""

    wheel: str  # whose motor
    method: Method  # the method that was asked for
    problem: Problem  # the nominal motor and the targets
    required: RequiredMargins  # margins that the gains must keep
    ensemble: UncertaintyEnsemble  # motors within the uncertainty
    drawn: bool  # False where the ensemble is the nominal motor alone
    friction: Friction  # range of the dry friction
    driver: Driver  # effects of its driver
    load: float  # magnitude of a constant load [V]
    torque_noise: float  # fluctuating load, averaged over a sample [V rms]
    scatter: float  # timing jitter of commands and samples [s rms]
    eccentric: float  # amplitude of the encoder error once a turn [rad]
    outliers: float  # share of outliers among the readings of the reported speed
    lag_in_doubt: bool  # whether the second lag may be a filter of the reported speed
    findings: tuple[Finding, ...]  # about the estimate

    @property
    def lost_voltage(self) -> float:
        """Voltage [V] lost to friction and driver at least, which the feed-forward adds."""
        return self.friction.known + self.driver.threshold

    @property
    def breakaway(self) -> float:
        """Smallest command [V] at which every motor turns; at most the supply."""
        commands = np.linspace(0.0, self.problem.loop.supply_voltage, 256)
        numbers, lane = self.driver.numbers, self.driver.lane
        volts = [apply_driver(numbers, lane, v, 0.0, v, 1.0)[0] for v in commands.tolist()]
        enough = int(np.searchsorted(volts, self.friction.planned + self.load))
        return float(commands[min(enough, commands.size - 1)])


def prepare(estimate: Estimate, loop: Loop, method: str, targets: dict[str, Any]) -> Case:
    """Sample the motor and the draws of its distribution; see :func:`design`."""
    chosen = _check_method(method, targets)
    findings = list(_check_reliability(estimate, bool(targets.get("accept_unreliable"))))
    driver = make_driver(
        rebuild_chain(estimate.chain),
        estimate.largest_voltage,
        estimate.hardware.supply_voltage or 0.0,
    )
    loop = _limit_by_driver(driver, loop)
    friction = bound_friction(estimate, loop.supply_voltage)
    lag = report_sensor_lag(estimate) if loop.reports_speed else None
    level = next((f for f in estimate.findings if f.code == "one_size_of_voltage"), None)
    findings += [one for one in (friction.finding, lag, level) if one is not None]
    # The reference leaves room for the whole loss.
    load = abs(estimate.value("load_voltage"))
    lost = friction.planned + driver.threshold + load
    plant = sample(replace(make_motors(estimate), static_voltage=np.array([lost])), loop)
    problem = Problem(plant, loop, targets, unmodelled_dynamics(estimate))
    required = replace(
        chosen.required,
        phase=problem.target("phase_margin", chosen.required.phase),
        sensitivity=problem.target("maximum_sensitivity", chosen.required.sensitivity, least=1.0),
    )
    n = int(check_target(targets, "samples") or 1000)
    seed = int(check_target(targets, "seed", least=-1) or 0)
    # Eigenvalues cost with the cube of the states: fewer motors where a loop has many.
    states = plant.taps.shape[1] + plant.window + 6
    n = max(min(n, int(WORK / states**3)), MIN_DRAWS)
    motors = draw_motors(estimate, n, np.random.default_rng(seed), friction)
    if motors is not None and lag is not None:
        motors = alternate_motors(motors, move_lag_to_sensor(motors))
    draws = plant if motors is None else sample(motors, loop, believed=plant.motors)
    ensemble = UncertaintyEnsemble(draws, required, problem)
    if motors is None:
        words = "the estimate has no uncertainty: the margins are those of one motor"
        findings.append(Finding("no_uncertainty", "warning", words))
    return Case(
        estimate.wheel,
        chosen,
        problem,
        required,
        ensemble,
        motors is not None,
        friction,
        driver,
        load,
        compute_torque_noise(estimate, loop.sample_time),
        estimate.evidence("arrival_beat", "latency"),
        abs(estimate.chain.values.get("eccentricity", 0.0)),
        compute_outlier_share(estimate) if loop.reports_speed else 0.0,
        lag is not None,
        tuple(findings),
    )


def _limit_by_driver(driver: Driver, loop: Loop) -> Loop:
    """Return a loop with the limits of its driver; a ramp delays by half of its length.

    The margins cover this delay; planned changes are no faster than the driver and have none.
    """
    supply = min(loop.supply_voltage, driver.limit)
    longest = loop.loop_delay + 0.5 * supply / driver.slew
    return replace(loop, supply_voltage=supply, delay=longest, usual_delay=loop.expected_delay)


def _check_reliability(estimate: Estimate, accepted: bool) -> tuple[Finding, ...]:
    """Refuse an unreliable estimate, or return a finding on the assumed uncertainty."""
    grave = [f for f in estimate.findings if f.severity in ("unreliable", "refused")]
    if not grave:
        return ()
    words = "; ".join(f"{f.message}" + (f" ({f.advice})" if f.advice else "") for f in grave)
    if not accepted:
        raise DesignError(
            f"{estimate.wheel}: the identification is unreliable: {words}; gains designed on it "
            "may fail. Record as advised, or accept this with --accept-unreliable"
        )
    spread = unreliable_spread(estimate)
    message = (
        f"designed on an unreliable identification ({words}): every parameter is assumed "
        f"uncertain by at least {100 * spread:.0f} %"
    )
    return (Finding("unreliable_identification", "unreliable", message, {"spread": spread}),)


def solve(case: Case) -> tuple[Feedback, float, Robustness]:
    """Find the feedback gains, reduced as the uncertainty requires."""
    ruled = case.method.solve(case.problem)
    quiet, calm = _reduce_noise(case.problem, ruled)
    feedback, factor, robustness = back_off(case.ensemble.assess, quiet)
    factor *= calm
    if factor == 0.0:
        known = describe_known_band(case.problem.unmodelled)
        raise DesignError(
            f"{case.wheel}: no gains of this kind keep a phase margin of "
            f"{case.required.phase:g} deg and Ms {case.required.sensitivity:g} for 99 % of the "
            f"motors within the uncertainty (for {100 * robustness.holds:.0f} %){known}; record "
            "more, or ask for smaller margins"
        )
    return feedback, factor, robustness


def assess(case: Case, feedback: Feedback) -> tuple[Feedback, float, Robustness]:
    """Return given gains as :func:`solve` returns its own; refuse those of an unstable loop."""
    robustness = case.ensemble.assess(feedback)
    if robustness.stable < 1.0:
        raise DesignError(
            f"{case.wheel}: with these gains the loop is unstable for "
            f"{100 * (1 - robustness.stable):.0f} % of the motors within the uncertainty; lower p, "
            "i or d"
        )
    return feedback, 1.0, robustness


def _reduce_noise(problem: Problem, feedback: Feedback) -> tuple[Feedback, float]:
    """Reduce gains until the control noise fits within the clamp."""
    factor, trial = 1.0, feedback
    while (
        problem.control_noise(trial) > MAX_CONTROL_NOISE * problem.loop.supply_voltage
        and factor > 0.01
    ):
        factor *= 0.95
        trial = reduce_crossover(feedback, factor)
    return trial, factor


def _check_method(name: str, targets: dict[str, Any]) -> Method:
    if name not in METHODS:
        raise DesignError(f"method is {name!r}; it must be one of {', '.join(METHODS)}")
    known = (*METHODS[name].targets, *COMMON_TARGETS)
    unknown = [key for key in targets if key not in known]
    if unknown:
        raise DesignError(
            f"the method {name!r} has no target {unknown[0]!r}; it has {', '.join(known)}"
        )
    return METHODS[name]
