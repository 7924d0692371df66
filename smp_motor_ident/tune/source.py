# SPDX-License-Identifier: Apache-2.0
"""Choose the source of the speed: the hardware, differenced counts, or the observer.

A difference over more samples has less noise and more lag; the observer has little of both while
its model is right.  Gains are designed for each source within the same margins and control noise.
The source with the best load rejection is chosen, provided that every drawn motor settles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.case import Case, Robustness, prepare, solve
from smp_motor_ident.tune.designer import settles
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.loop import Loop

WINDOWS = (2, 4, 8, 16)
"""Tried windows of the difference [samples]."""

WINDOW_BENEFIT, OBSERVER_BENEFIT = 1.15, 1.5
"""Required ratio of integral gains for a longer window, and for the observer, which depends on the
model."""

DRAWS = 200


@dataclass(frozen=True)
class Trial:
    """Gains of one source of the speed."""

    loop: Loop  # with the source
    case: Case  # the motor in that loop
    solved: tuple[Feedback, float, Robustness]  # gains within the margins

    @property
    def integral(self) -> float:
        """Integral gain [V/rad, wheel]; the error that a load leaves is its inverse."""
        return self.solved[0].i * self.loop.gear_ratio

    @property
    def control_noise(self) -> float:
        """Voltage from the measurement's noise [V rms]."""
        return self.case.problem.control_noise(self.solved[0])

    def settles(self) -> bool:
        """Return whether a largest settling time can be stated."""
        try:
            return settles(self.case, self.solved[0])
        except DesignError:
            return False

    @property
    def name(self) -> str:
        """In words."""
        if self.loop.speed_source == "difference":
            return f"counts differenced over {self.loop.difference_window} samples"
        observed = self.loop.speed_source == "observer"
        return "the observer" if observed else "the reported speed"


def choose_source(estimate: Estimate, loop: Loop, **targets: Any) -> tuple[Loop, str]:
    """Return the loop with the speed source to take, and the reason."""
    usual = _try_source(estimate, loop, targets)
    if loop.counts_per_revolution is None:
        words = "the reported speed: the encoder's counts are not known"
        return loop, words + _remark_on_averaging(estimate, loop, usual, targets)
    # The window of a recorded speed is unknown; the shortest one of counts is one sample.
    counted = replace(
        loop, speed_source="difference", difference_window=max(loop.difference_window, 1)
    )
    longer = _try_windows(estimate, counted, usual, targets)
    watched = _try_source(estimate, replace(loop, speed_source="observer"), targets)
    best, unsettled = _select_trial(usual, longer, watched)
    if best is None:
        return loop, "the reported speed: no source meets the targets"
    compared = "; ".join(
        f"{t.name} allows i = {t.integral:.3g} V/rad "
        f"at {1e3 * t.control_noise:.3g} mV of control noise"
        for t in (usual, longer, watched)
        if t is not None
    )
    lacks = "".join(f"; not {t.name}: some motors do not settle with it" for t in unsettled)
    return best.loop, f"{best.name}: {compared}{lacks}"


def _select_trial(*trials: Trial | None) -> tuple[Trial | None, Sequence[Trial]]:
    """Return the best trial in which every motor settles, and the better ones rejected."""
    left = [
        (t, w) for t, w in zip(trials, (1.0, WINDOW_BENEFIT, OBSERVER_BENEFIT), strict=True) if t
    ]
    passed: list[Trial] = []
    while left:
        best = left[0]
        for each in left[1:]:
            if each[0].integral > each[1] * best[0].integral:
                best = each
        if best[0].settles():
            return best[0], passed
        left.remove(best)
        passed.append(best[0])
    return (passed[0] if passed else None), ()


def _try_windows(
    estimate: Estimate, loop: Loop, usual: Trial | None, targets: dict[str, Any]
) -> Trial | None:
    """Return the best of the longer windows if the control noise limits the gains; else None."""
    if usual is not None and usual.control_noise <= 0.9 * loop.noise_limit:
        return None
    windows = [
        _try_source(estimate, replace(loop, difference_window=w), targets)
        for w in WINDOWS
        if w > loop.difference_window
    ]
    return max((t for t in windows if t is not None), key=lambda t: t.integral, default=None)


def _remark_on_averaging(
    estimate: Estimate, loop: Loop, usual: Trial | None, targets: dict[str, Any]
) -> str:
    """Return a remark on the benefit of differencing an angle over more samples.

    The hardware differences the angle, so the controller cannot choose the window.
    """
    if not (loop.angle_noise and loop.difference_window and loop.reports_speed):
        return ""
    taken = (
        f", assumed to be the angle's difference over {loop.difference_window} samples of the loop"
    )
    longer = _try_windows(estimate, loop, usual, targets)
    if longer is None or (usual is not None and longer.integral < WINDOW_BENEFIT * usual.integral):
        return taken
    window, now = longer.loop.difference_window, 0.0 if usual is None else usual.integral
    return (
        f"{taken}, which allows i = {now:.3g} V/rad; report it differenced over {window}, and give "
        f"--difference-window {window}, for i = {longer.integral:.3g} V/rad"
    )


def _try_source(estimate: Estimate, loop: Loop, targets: dict[str, Any]) -> Trial | None:
    # The allowed control noise is a strict limit here, so that no source gains by noise.
    strict = replace(loop, noise_voltage=loop.noise_limit)
    try:
        case = prepare(estimate, strict, "margin", {**targets, "samples": DRAWS})
        return Trial(loop, case, solve(case))
    except DesignError:
        return None
