"""Choice among the ladder: the simplest model that the data do not reject, with reasons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident import cold, models, start
from smp_motor_ident import recursion as rc
from smp_motor_ident.cold import Options
from smp_motor_ident.experiments import Experiments
from smp_motor_ident.fit import Fit
from smp_motor_ident.models import Structure

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rung:
    """A fitted structure and what was decided about it."""

    fit: Fit
    reason: str = ""

    @property
    def label(self) -> str:
        """Name of the structure with what was added to it."""
        return label(self.fit.structure)

    @property
    def bic(self) -> float:
        """Bayesian information criterion."""
        return bic(self.fit)


def label(structure: Structure) -> str:
    """Return a structure's name in words.

    Parameters
    ----------
    structure : Structure
        Any.

    Returns
    -------
    str
        Such as ``first_order with delay``.
    """
    added = [
        word
        for flag, word in (
            (structure.friction == "none", "no friction"),
            (structure.friction == "asymmetric", "asymmetric friction"),
            (structure.load, "load"),
            (structure.delay, "delay"),
            (structure.window, "averaged speed"),
            (structure.offset, "current offset"),
        )
        if flag
    ]
    return structure.name + (" with " + ", ".join(added) if added else "")


def bic(fit: Fit) -> float:
    """Return the Bayesian information criterion of a fit.

    Parameters
    ----------
    fit : Fit
        Any.

    Returns
    -------
    float
        Deviance + parameters x ln(samples).
    """
    return fit.deviance + len(fit.structure.free()) * float(np.log(fit.samples))


def inflation(fit: Fit) -> float:
    """Return by how much the scores scatter more than white residuals would let them.

    Parameters
    ----------
    fit : Fit
        Any.

    Returns
    -------
    float
        At least 1; deviances are divided by it before they are compared.
    """
    white = np.diag(np.linalg.pinv(fit.information, hermitian=True))
    return float(max(1.0, np.median(np.diag(fit.covariance()) / np.maximum(white, 1e-300))))


def needed(simple: Fit, rich: Fit) -> tuple[bool, str]:
    """Decide whether the data reject the simpler of two models.

    Parameters
    ----------
    simple, rich : Fit
        On the same data.

    Returns
    -------
    verdict : bool
        Whether ``rich`` is needed.
    reason : str
        In words.
    """
    more = len(rich.structure.free()) - len(simple.structure.free())
    gained = (simple.deviance - rich.deviance) / inflation(rich)
    price = more * float(np.log(simple.samples))
    if not rich.converged and gained < 10 * price:
        return False, "did not converge"
    if gained <= price:
        return (
            False,
            f"no better than {label(simple.structure)} (gain {gained:.0f}, price {price:.0f})",
        )
    loose = _loose(simple, rich)
    if loose:
        return False, f"its {loose} cannot be told from these data"
    return True, f"{label(simple.structure)} is rejected (gain {gained:.0f}, price {price:.0f})"


def _loose(simple: Fit, rich: Fit) -> str:
    cov = rich.covariance()
    free = rich.structure.free()
    for i in set(free) - set(simple.structure.free()):
        name = models.Z_NAMES[i]
        std = float(np.sqrt(cov[free.index(i), free.index(i)]))
        if name in ("delay", "window") and std > 0.4 * rich.z[i]:
            return name
        if name == "ln_a2" and std > 0.4:
            return "second time constant"
    return ""


Say = Callable[[str], None]


def explore(
    data: Experiments, base: Structure, options: Options, auto: bool, say: Say
) -> list[Rung]:
    """Fit the rungs that come into question; the last one is the choice.

    Parameters
    ----------
    data : Experiments
        Prepared records.
    base : Structure
        What the user asked for, or where ``auto`` begins.
    options : Options
        Loss and prior knowledge.
    auto : bool
        Whether the order may be chosen.
    say : callable
        Told what is being done.

    Returns
    -------
    list of Rung
        In the order of trial, the chosen one at the end.
    """
    rungs: list[Rung] = []
    if base.current or not auto:
        first = _cold(data, base, options, say)
        if first is None:
            return []
        best = first
        rungs.append(Rung(first, "asked for" if not auto else "current is measured"))
    else:
        found = _orders(data, base, options, say, rungs)
        if found is None:
            return []
        best = found
    best = _variations(data, best, options, rungs, say, auto)
    reason = next((r.reason for r in rungs if r.fit is best), "")
    return [r for r in rungs if r.fit is not best] + [Rung(best, reason)]


def _cold(data: Experiments, s: Structure, options: Options, say: Say) -> Fit | None:
    say(f"fitting {label(s)}")
    if s.delay:
        return _with_delay(data, s.with_(delay=False), options, None)
    return cold.cold_fit(data, s, options)


def _orders(
    data: Experiments, base: Structure, options: Options, say: Say, rungs: list[Rung]
) -> Fit | None:
    """Climb from first order without delay as far as the data ask."""
    first = replace(base, name="first_order", order=1, shape=False)
    second = replace(base, name="second_order", order=2)
    best: Fit | None = None
    for structure in (first, first.with_(delay=True), second, second.with_(delay=True)):
        if "delay" in base.held and structure.delay:
            continue
        say(f"fitting {label(structure)}")
        if structure.delay:
            plain = next(
                (r.fit for r in rungs if r.fit.structure == structure.with_(delay=False)), None
            )
            fitted = _with_delay(data, structure.with_(delay=False), options, plain)
        else:
            extra = []
            if structure.order == 2 and best is not None:
                z = best.z.copy()
                slow = np.exp(z[models.A1] - z[models.A0])
                z[models.A2] = z[models.A1] + np.log(max(z[models.DELAY], 0.05 * slow))
                z[models.TE] = z[models.A2] - z[models.A1]
                z[models.DELAY] = 0.0
                extra = [z]
            fitted = cold.cold_fit(data, structure, options, extra)
        if fitted is None:
            continue
        if best is None:
            best = fitted
            rungs.append(Rung(fitted, "the simplest"))
            continue
        same_size = len(fitted.structure.free()) == len(best.structure.free())
        if same_size:
            verdict = fitted.deviance < best.deviance - 2 * inflation(fitted)
            reason = f"{'fits better' if verdict else 'fits worse'} than {label(best.structure)}"
        else:
            verdict, reason = needed(best, fitted)
        rungs.append(Rung(fitted, reason))
        if verdict:
            best = fitted
    return best


def _with_delay(
    data: Experiments, structure: Structure, options: Options, plain: Fit | None
) -> Fit | None:
    """Fit with a delay, started from several: the surface has a valley for each sample."""
    delayed = structure.with_(delay=True)
    starts = []
    if plain is not None:
        z = plain.z.copy()
        z[models.DELAY] = 0.2 * data.step
        starts.append(z)
    for lag in (0, 1, 2, 4, 8, 16, 32):
        # The regressions of a lagged input are those of a delayed motor.
        for z in start.lagged_candidates(data, structure, lag):
            z[models.DELAY] = max(lag - 0.5, 0.1) * data.step
            starts.append(z)
    return cold.cold_fit(data, delayed, options, starts, keep=4, own=False)


def _variations(
    data: Experiments, best: Fit, options: Options, rungs: list[Rung], say: Say, auto: bool
) -> Fit:
    """Add what the data ask for, take away what they do not show."""
    s = best.structure
    if data.kind == rc.SPEED and "window" not in s.held and auto:
        best = _averaged(data, best, options, rungs, say)
    trials: list[dict[str, object]] = []
    if best.structure.order == 2 and not best.structure.current and not best.structure.shape:
        trials.append({"shape": True})
    if best.structure.current:
        trials.append({"offset": True})
        if "delay" not in s.held and not best.structure.delay:
            trials.append({"delay": True})
    if best.structure.friction == "symmetric":
        trials.append({"load": True})
        trials.append({"friction": "asymmetric", "load": True})
    for change in trials:
        richer = best.structure.with_(**change)
        if richer == best.structure:
            continue
        say(f"trying {label(richer)}")
        z = best.z.copy()
        if "delay" in change:
            z[models.DELAY] = 0.3 * data.step
        other = cold.refine(data, richer, best, z, options)
        verdict, reason = needed(best, other)
        rungs.append(Rung(other, reason))
        if verdict:
            best = other
    s = best.structure
    if s.friction == "symmetric" and "vc_plus" not in s.held:
        cov = best.covariance()
        i = s.free().index(models.VC_PLUS)
        if best.z[models.VC_PLUS] < 3 * np.sqrt(cov[i, i]):
            plain = cold.refine(data, s.with_(friction="none", shape=False), best, best.z, options)
            keep, reason = needed(plain, best)
            if not keep:
                rungs.append(Rung(plain, "no Coulomb friction shows"))
                best = plain
    return best


def _averaged(data: Experiments, best: Fit, options: Options, rungs: list[Rung], say: Say) -> Fit:
    """Try whether what looks like a delay is a speed averaged over a trailing window."""
    say("trying a speed averaged over a window")
    mean = data.as_mean_speed()
    plain = best.structure.with_(window=True, delay=False)
    lag = max(best.z[models.DELAY], data.step)
    candidates = []
    for structure in (plain, plain.with_(delay=True)):
        if "delay" in best.structure.held and structure.delay:
            continue
        starts = []
        for width in (1.0, 2.0, 1.5) if not structure.delay else (1.0, 1.6, 0.5):
            z = best.z.copy()
            z[models.WINDOW] = max(width * lag, 1.01 * data.step)
            z[models.DELAY] = max(lag - 0.5 * z[models.WINDOW], 0.1 * data.step)
            if not structure.delay:
                z[models.DELAY] = 0.0
            starts.append(z)
        fitted = cold.cold_fit(mean, structure, options, starts, keep=3, own=False)
        if fitted is not None:
            candidates.append(fitted)
    for fitted in candidates:
        if len(fitted.structure.free()) == len(best.structure.free()):
            verdict = fitted.deviance < best.deviance - 2 * inflation(fitted)
            reason = f"{'fits better' if verdict else 'fits worse'} than {label(best.structure)}"
        else:
            verdict, reason = needed(best, fitted)
        rungs.append(Rung(fitted, reason))
        if verdict:
            best = fitted
    return best
