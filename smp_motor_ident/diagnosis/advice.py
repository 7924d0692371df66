"""What the result means in words: doubts about it, and what to record to know more."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from smp_motor_ident.estimation import replay
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.quantities import Answer
from smp_motor_ident.likelihood import recursion as rc
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model import structures as models
from smp_motor_ident.model.structures import PHYSICAL
from smp_motor_ident.result import ResidualTests

TOO_FAST = 1.5  # radians a sample; at pi a ringing cannot be told from a slower one
STEADY = 4.0  # time constants after which a motor's speed is steady
UNEXPLAINED = 9.0  # residual variance over that of the counter that no counter makes


def doubts(
    fit: Fit,
    result: Answer,
    estimation: float,
    validation: float | None,
    tests: ResidualTests,
    data: Experiments,
) -> list[str]:
    """Return warnings about an estimate.

    Parameters
    ----------
    fit, result : Fit, Answer
        The estimate.
    estimation, validation : float
        Fit percent.
    tests : ResidualTests
        Of the innovations.
    data : Experiments
        What was fitted.

    Returns
    -------
    list of str
        Empty where nothing speaks against the result.
    """
    out = []
    s = fit.structure
    if not fit.converged and _unsettled(data, fit):
        out.append("doubtful: the fit did not settle; record a longer or stronger excitation")
    if estimation < 70:
        out.append(f"doubtful: the model explains only {estimation:.0f} % of the speed")
    if validation is not None and validation < estimation - 15:
        out.append(
            f"doubtful: held-out data fit {validation:.0f} % against {estimation:.0f} %; the "
            "motor or its load changed, or the excitation was too poor"
        )
    own = data.quantum**2 / 12
    beyond = 0 < UNEXPLAINED * own < fit.noise[0, 0] and fit.ratio == 0
    if data.kind == rc.ANGLE and beyond and tests.white is False:
        out.append(
            f"doubtful: the motion leaves the model by {np.sqrt(fit.noise[0, 0] / own):.0f} times "
            "the counter's resolution, and not at random; sample faster, or look for what else "
            "drives it"
        )
    ring = _ring(fit)
    if ring * data.step > TOO_FAST:
        out.append(
            f"doubtful: the answer rings at {ring / (2 * np.pi):.3g} Hz, which sampling at "
            f"{1 / data.step:.4g} Hz hardly shows; sample faster"
        )
    if tests.independent_of_input is False and estimation < 95:
        far = "doubtful: " if estimation < 90 else ""
        out.append(
            f"{far}the residuals still follow the voltage: the motor does what the model does not"
        )
    if s.offset and s.current:
        offset = fit.z[models.OFFSET]
        out.append(
            f"current has an offset of {1e3 * offset:.3g} mA, removed; zero the sensor at rest"
        )
    if s.window or "window" in s.held:
        window = fit.z[models.WINDOW]
        out.append(
            f"the speed is averaged over {1e3 * window:.3g} ms: {1e3 * window / 2:.3g} ms of what "
            "looks like a delay is that filter, not the motor"
        )
    if fit.ratio > 0 and data.kind == rc.ANGLE:
        if not s.current and _plain_square(data, fit):
            out.append(
                "doubtful: a plain square tells friction from gain at its reversals alone, and a "
                "load that fluctuates hides them; add a sine, a Fourier wave, or the current"
            )
        out.append(
            "the motion scatters beyond the counter's resolution (a load that fluctuates, or a "
            "command that switches between samples); the estimate allows for it"
        )
    return out


def _plain_square(data: Experiments, fit: Fit) -> bool:
    """Tell whether the command goes there and back, always as far, and waits for steady speed.

    Rest before and after it does not count; two levels in quick succession are another matter.
    """
    value = data.section_value
    driven = value[np.abs(value) > 0.05 * np.abs(value).max()]
    there, back = driven[driven > 0], -driven[driven < 0]
    if not there.size or not back.size:
        return False
    level = np.where(driven > 0, np.median(there), np.median(back))
    turns = data.section_end[:-1][np.diff(np.sign(value)) != 0]
    lag = float(np.exp(fit.z[models.A1] - fit.z[models.A0]))
    return bool(
        np.mean(np.abs(np.abs(driven) - level) < 0.03 * level) > 0.95
        and turns.size > 1
        and np.median(np.diff(turns)) > STEADY * lag
    )


def _ring(fit: Fit) -> float:
    """Return the frequency at which an underdamped motor rings [rad/s], else 0."""
    if fit.structure.order != 2:
        return 0.0
    a0, a1, a2 = np.exp(fit.z[: models.A2 + 1])
    return float(np.sqrt(a0 / a2)) if a1 * a1 < a0 * a2 else 0.0


def _unsettled(data: Experiments, fit: Fit) -> bool:
    """Tell whether a further step would still move what is reported by half its uncertainty.

    A descent may end at a kink, or along L/R beside the response, which nothing reports.
    """
    _, step, _ = replay.promise(data, fit, fit.structure)
    free = np.array(fit.structure.free())
    told = (free != models.TE) | fit.structure.current
    return bool(np.any(np.abs(step) > 0.5 * np.sqrt(np.diag(fit.covariance())), where=told))


def advise(fit: Fit, result: Answer, known: Mapping[str, float]) -> list[str]:
    """Return what to record or measure to know what is not known.

    Parameters
    ----------
    fit, result : Fit, Answer
        The estimate.
    known : mapping of str to float
        What the user fixed.

    Returns
    -------
    list of str
        One sentence each.
    """
    missing = [n for n in PHYSICAL if result.parameters[n].status == "unidentifiable"]
    out = []
    s = fit.structure
    if missing and not s.current:
        words = ", ".join(missing)
        out.append(
            f"voltage and speed alone cannot separate {words}: any of a family of motors answers "
            "the same; record the motor current too, the combinations are what is known"
        )
        if "resistance" not in known:
            out.append(
                "with the resistance measured by ohmmeter one unknown less remains, yet not all "
                "can be separated without current"
            )
    if missing and s.current:
        if "inductance" in missing:
            out.append(
                "inductance does not show at this rate: sample faster or excite at higher frequency"
            )
        others = [n for n in missing if n != "inductance"]
        if others:
            out.append(
                f"{', '.join(others)}: excite harder, longer, over more frequencies and in "
                "both directions"
            )
    free = s.free()
    if models.VC_PLUS in free and s.friction != "none":
        cov = fit.covariance()
        i = free.index(models.VC_PLUS)
        std = float(np.sqrt(cov[i, i]))
        if std > 0.5 * abs(fit.z[models.VC_PLUS]) and std > 0.05:
            out.append("static friction hardly shows: drive both directions, slowly through zero")
    return out
