# SPDX-License-Identifier: Apache-2.0
"""Maximise the integral gain under phase margin, Ms and control noise.

Crossover, phase margin and share of the derivative span every PI and PID controller; the
search looks at thousands at once on the sampled loop's frequency response, then zooms in.

References
----------
.. [1] K. J. Astrom, H. Panagopoulos, T. Hagglund, Design of PI controllers based on
   non-convex optimization, Automatica 34 (1998), 585-601: largest integral gain under Ms.
.. [2] K. J. Astrom, T. Hagglund, Advanced PID Control (2006), sections 4.6 and 6.7.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.errors import DesignError
from smp_motor_ident.limits import MAX_SPEED_NOISE
from smp_motor_ident.tune.feedback import Feedback, loop_margins, spectral_radius, terms
from smp_motor_ident.tune.methods.rules import SIMC
from smp_motor_ident.tune.problem import Method, Problem, RequiredMargins
from smp_motor_ident.tune.unmodelled import describe_known_band

FOCUS = ("balanced", "tracking", "load")
MAX_NOISE_RAISES, CONTROL_NOISE_TARGET, SPEED_NOISE_TARGET = 8, 1.2, 1.0
"""Largest number of raises of a noise limit, each by a fifth; ratio of the integral gain to that of
SIMC at which they end, for the limits of control noise and of speed noise."""

MAX_COMPLEMENTARY_PEAK = {"balanced": 1.25, "tracking": 1.05, "load": math.inf}
"""Largest peak of the complementary sensitivity, by focus."""


_Found = tuple[Feedback, float]
"""Feedback and its crossover."""


@dataclass(frozen=True, eq=False)
class _Gains:
    p: Array
    i: Array
    d: Array
    filter_time: Array
    crossover: Array
    margin: Array
    share: Array


def _solve(problem: Problem) -> Feedback:
    focus = str(problem.targets.get("focus") or "balanced")
    if focus not in FOCUS:
        raise DesignError(f"focus is {focus!r}; it must be one of {', '.join(FOCUS)}")
    margin = problem.target("phase_margin", 60.0)
    if margin >= 90:
        raise DesignError(f"phase_margin is {margin:g} deg; it must be below 90")
    peak = problem.target("maximum_sensitivity", 1.4, least=1.0)
    if "bandwidth" in problem.targets and problem.targets["bandwidth"] is not None:
        return _solve_bandwidth(problem, problem.target("bandwidth", 1.0), margin, peak)
    found = _search(problem, margin, peak, focus)
    found = _match_simc(problem, found, margin, peak, focus)
    if found is None:
        known = describe_known_band(problem.unmodelled, ", where ")
        raise DesignError(
            f"no controller keeps a phase margin of {margin:g} deg, Ms {peak:g} and a control "
            f"noise of {problem.loop.noise_limit:.3g} V{known}; "
            f"{_describe_nearest(problem, margin, peak, focus)}"
        )
    return found[0]


def _describe_nearest(problem: Problem, margin: float, peak: float, focus: str) -> str:
    """Return in words the nearest demand that can be met."""
    for more in (1.05, 1.1, 1.2, 1.3, 1.4, 1.6, 2.0):
        if more > peak and _search(problem, margin, more, focus) is not None:
            return f"the nearest that holds has Ms {more:g}"
    for factor in (2.0, 5.0, 10.0, 100.0):
        limit = factor * problem.loop.noise_limit
        noisier = replace(problem, loop=replace(problem.loop, noise_voltage=limit))
        if _search(noisier, margin, max(peak, 1.4), focus) is not None:
            return (
                f"the nearest that holds has a control noise of {limit:.3g} V and "
                f"Ms {max(peak, 1.4):g}"
            )
    return "no similar design does; shorten the delay, or use an encoder with more counts"


def _match_simc(
    problem: Problem, found: _Found | None, margin: float, peak: float, focus: str
) -> _Found | None:
    """Raise the default noise limits until the load rejection matches SIMC's.

    SIMC ignores noise, so at the same Ms the defaults could do worse.  Noise that moves the wheel
    out of its settling band costs more than noise in the voltage: it is allowed last.
    """
    loop = problem.loop
    if loop.noise_voltage is not None:
        return found
    rule = SIMC.solve(replace(problem, targets={}))

    def better(trial: _Found | None) -> float:
        if trial is None:
            return 0.0
        sensitivity = float(np.abs(problem.closed(trial[0])[1]).max())
        return trial[0].i / scale_to_sensitivity(problem, rule, sensitivity).i

    best, most = found, better(found)
    steps = 1.2 ** np.arange(1, MAX_NOISE_RAISES + 1)
    for step in steps:
        # The integral of the error is 1/i; that of its magnitude is up to some percent more.
        if most >= CONTROL_NOISE_TARGET:
            return best
        louder = replace(loop, noise_voltage=step * loop.noise_limit)
        trial = _search(replace(problem, loop=louder), margin, peak, focus)
        if better(trial) > 1.02 * most:
            best, most = trial, better(trial)
    for step in steps:
        if most >= SPEED_NOISE_TARGET:
            break
        trial = _search(replace(problem, speed_noise_factor=float(step)), margin, peak, focus)
        if trial is not None and (best is None or trial[0].i > 1.02 * best[0].i):
            best, most = trial, better(trial)
    return best


def scale_to_sensitivity(problem: Problem, shape: Feedback, peak: float) -> Feedback:
    """Scale gains by the largest factor that keeps Ms."""
    factors = np.geomspace(0.01, 4.0, 800)
    base = problem.response * shape.response(problem.omega, problem.loop.sample_time)
    over = np.abs(1 + factors[:, None] * base).min(axis=1) < 1 / peak
    largest = int(np.argmax(over)) if over.any() else factors.size
    return shape.scaled(float(factors[max(largest - 1, 0)]))


def _search(
    problem: Problem, margin: float, peak: float, focus: str, bandwidth: float | None = None
) -> _Found | None:
    """Return the best feedback and its crossover, zooming in twice, or None."""
    omega = problem.omega
    # Ms implies at least this phase margin.
    margin = max(margin, 0.95 * math.degrees(2 * math.asin(min(0.5 / peak, 1.0))))
    shares = np.zeros(1) if problem.structure == "pi" else _DERIVATIVE_SHARES
    if bandwidth is None:
        crossovers = np.geomspace(omega[0], 0.6 * omega[-1], 60)
    else:
        crossovers = np.array([bandwidth])
    margins = np.linspace(margin, min(margin + 35, 95), 8, dtype=np.float64)
    best: tuple[Feedback, float] | None = None
    for zoom in (1.0, 0.3, 0.08):
        found = _select_candidate(problem, crossovers, margins, shares, margin, peak, focus)
        if found is None:
            return best
        best = found[0], found[1]
        crossover, phase, share = found[1:]
        ratio = (omega[-1] / omega[0]) ** (zoom / 60)
        if bandwidth is None:
            crossovers = np.append(crossover * np.geomspace(1 / ratio, ratio, 17), crossover)
        margins = np.append(np.clip(phase + np.linspace(-5, 5, 8) * zoom, margin, 95), phase)
        if shares.size > 1:
            shares = np.append(np.clip(share + np.linspace(-0.2, 0.2, 7) * zoom, 0, 1.5), share)
    return best


_DERIVATIVE_SHARES = np.array([0.0, 0.15, 0.3, 0.45, 0.6, 0.8, 1.0])


def _select_candidate(
    problem: Problem,
    crossovers: Array,
    margins: Array,
    shares: Array,
    margin: float,
    peak: float,
    focus: str,
) -> tuple[Feedback, float, float, float] | None:
    c = _candidates(problem, crossovers, margins, shares)
    if c.p.size == 0:
        return None
    good = _filter(problem, c, margin, peak, MAX_COMPLEMENTARY_PEAK[focus])
    merit = np.where(good, c.crossover if focus == "tracking" else c.i, -np.inf)
    for k in np.argsort(-merit)[:20]:
        if not good[k]:
            return None
        feedback = Feedback(
            float(c.p[k]), float(c.i[k]), float(c.d[k]), float(c.filter_time[k]) if c.d[k] else 0.0
        )
        if spectral_radius(problem.plant, feedback)[0] < 1:
            return feedback, float(c.crossover[k]), float(c.margin[k]), float(c.share[k])
    return None


def _candidates(problem: Problem, crossovers: Array, margins: Array, shares: Array) -> _Gains:
    """Return the gains with the given crossover and phase."""
    T = problem.loop.sample_time
    w, pm, share = (x.ravel() for x in np.meshgrid(crossovers, margins, shares, indexing="ij"))
    plant = np.repeat(problem.plant.response(crossovers)[0], margins.size * shares.size)
    needed = -np.exp(1j * np.deg2rad(pm)) / plant
    d = share * np.abs(needed) / w
    filter_time = np.array([problem.filter_time(0.1 / x) for x in crossovers])
    filter_time = np.repeat(filter_time, margins.size * shares.size)
    integral, derivative = terms(w, T, filter_time)
    rest = needed - d * derivative
    i = rest.imag / integral.imag
    p = rest.real - i * integral.real
    keep = (i > 0) & (p >= 0)
    return _Gains(*(x[keep] for x in (p, i, d, filter_time, w, pm, share)))


def _filter(problem: Problem, c: _Gains, margin: float, peak: float, hump: float) -> Array:
    """Return which candidates keep the margins, the peak of T, robustness and noise limits."""
    omega, T = problem.omega, problem.loop.sample_time
    integral, derivative = terms(omega, T, c.filter_time[:, None])
    control = c.p[:, None] + c.i[:, None] * integral + c.d[:, None] * derivative
    loop = control * problem.response
    back = 1 / (1 + loop)
    sensitivity = np.abs(back)
    good = sensitivity.max(axis=1) <= peak
    good &= np.abs(loop * back).max(axis=1) <= hump
    good &= np.abs(control * problem.uncertain * back).max(axis=1) <= 1
    # Nyquist: 1 + L comes from -90 deg and must end at 0 without having gone around.
    turned = np.angle(1 / back[:, 0]) + np.sum(np.angle(back[:, :-1] / back[:, 1:]), axis=1)
    good &= np.abs(turned) < 0.5
    # Outside the unit circle of Ms there may still be a later crossover: check each of them.
    near = np.abs(np.abs(loop) - 1) < 0.1
    good &= np.where(near, np.abs(np.angle(-loop)), np.pi).min(axis=1) >= np.deg2rad(0.9 * margin)
    good &= problem.noise_rms(control * back) <= problem.loop.noise_limit
    speed_noise = problem.noise_rms(control * back * problem.true_response)
    top = problem.loop.supply_voltage / float(problem.plant.motors.a0[0])
    return np.asarray(good & (speed_noise <= problem.speed_noise_factor * MAX_SPEED_NOISE * top))


def _solve_bandwidth(problem: Problem, wished: float, margin: float, peak: float) -> Feedback:
    nyquist = math.pi / problem.loop.sample_time
    found = _search(problem, margin, peak, "load", wished) if wished < nyquist else None
    if found is not None and loop_margins(problem.plant, found[0]).crossover < 1.05 * wished:
        return found[0]
    nearest = _search(problem, margin, peak, "tracking")
    hint = (
        "no bandwidth holds" if nearest is None else f"the nearest that holds is {nearest[1]:.4g}"
    )
    delay = 1e3 * (problem.loop.loop_delay + float(problem.plant.motors.delay[0]))
    raise DesignError(
        f"bandwidth {wished:.4g} rad/s cannot keep a phase margin of {margin:g} deg, Ms {peak:g} "
        f"and a control noise of {problem.loop.noise_limit:.3g} V with {delay:.3g} ms of delay at "
        f"{problem.loop.rate:.4g} Hz (Nyquist {nyquist:.4g} rad/s)"
        f"{describe_known_band(problem.unmodelled, ', where ')}; {hint} rad/s"
    )


MARGIN = Method(
    "margin",
    "largest integral gain under phase margin, Ms and control noise",
    "Astrom, Panagopoulos and Hagglund 1998",
    RequiredMargins(phase=60.0, gain=2.0, sensitivity=1.4),
    _solve,
    ("phase_margin", "maximum_sensitivity", "focus", "bandwidth", "structure"),
)
