# SPDX-License-Identifier: Apache-2.0
"""Design all wheels of a robot: gains for each or for all, and one common reference."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from smp_motor_control.reference.profile import Drive, Reference
from smp_motor_control.reference.time_optimal import VoltageLimited
from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.case import Case, Robustness, back_off, prepare, solve
from smp_motor_ident.tune.designer import Design, finish, with_reference
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.loop import Loop

Sets = Literal["auto", "one", "each"]

MAX_REJECTION_LOSS = 1.1
"""Loss of load rejection, as a factor, up to which one set of gains is preferred."""


@dataclass(frozen=True)
class WheelSet:
    """Designs of all wheels."""

    # By wheel; together they have one duration and one set of limits
    designs: Mapping[str, Design]
    reason: str  # why gains for one or all, and which motor limits the reference


def design_wheels(
    estimates: Mapping[str, Estimate],
    loops: Mapping[str, Loop],
    method: str = "margin",
    sets: Sets = "auto",
    together: bool = True,
    **targets: Any,
) -> WheelSet:
    """Design for every wheel of a robot."""
    if not estimates:
        raise DesignError("no motor was identified; identify a bag that holds one")
    together = together and len(estimates) > 1
    targets["together"] = together
    cases = {w: prepare(e, loops[w], method, targets) for w, e in estimates.items()}
    own = {wheel: finish(case, *solve(case)) for wheel, case in cases.items()}
    shared, reason = _choose_sets(cases, own, sets)
    if shared is not None:
        own = {wheel: _finish_shared(case, shared) for wheel, case in cases.items()}
    if not together:
        return WheelSet(own, f"{reason}; each as fast as its own voltage allows")
    common, pace = _plan_together(cases, own)
    return WheelSet(common, f"{reason}; {pace}")


def _finish_shared(case: Case, shared: Feedback) -> Design:
    """Finish a design with common gains, per rad/s of the wheel."""
    mine = shared.scaled(1 / case.problem.loop.gear_ratio)
    return finish(case, mine, 1.0, case.ensemble.assess(mine))


def _plan_together(
    cases: Mapping[str, Case], own: Mapping[str, Design]
) -> tuple[dict[str, Design], str]:
    """Return the designs with the one reference that all wheels can follow, and the reason."""

    each = {wheel: one.wheel_reference for wheel, one in own.items()}
    late = max(each, key=lambda w: each[w].transition_time)
    slow = min(each, key=lambda w: each[w].max_velocity)
    duration, speed = each[late].transition_time, each[slow].max_velocity
    rate = min(one.max_acceleration for one in each.values())
    drive = common_drive(own)
    together = {}
    for wheel, one in own.items():
        ratio = one.loop.gear_ratio
        common = replace(
            one.reference,
            transition_time=duration,
            max_velocity=speed * ratio,
            max_acceleration=rate * ratio,
            drive=replace(drive, top_speed=drive.top_speed * ratio),
        )
        together[wheel] = with_reference(cases[wheel], one, common)
    limited = "as voltage allows" if math.isinf(rate) else f"at most {rate:.3g} rad/s^2"
    return together, (
        f"one reference for all: {1e3 * duration:.0f} ms as {late} needs, up to {speed:.3g} rad/s "
        f"as {slow} reaches, larger changes as fast {limited}"
    )


def common_drive(designs: Mapping[str, Design]) -> Drive:
    """Return a motor whose fastest changes every one of these can follow."""
    references = [one.wheel_reference for one in designs.values()]
    drives = [one.drive for one in references]
    step = max(one.loop.sample_time for one in designs.values())
    common = Drive(
        top_speed=min(d.top_speed for d in drives),
        time_constant=max(d.time_constant for d in drives),
        time_constant_product=max(d.time_constant_product for d in drives),
    )
    largest = min(one.max_velocity for one in references)
    for _ in range(100):
        changes = [
            VoltageLimited(Reference(begin * largest, 0.0, 0.0), end * largest, common, step)
            for begin, end in ((0.0, 0.3), (0.0, 1.0), (1.0, 0.0), (-1.0, 1.0))
        ]
        if all(
            abs(drive.needed(change.at(s * change.duration))) <= 1.001 * drive.top_speed
            for change in changes
            for s in np.linspace(0.0, 0.999, 60)
            for drive in drives
        ):
            break
        common = replace(common, top_speed=0.98 * common.top_speed)
    return common


def _choose_sets(
    cases: Mapping[str, Case], own: Mapping[str, Design], sets: Sets
) -> tuple[Feedback | None, str]:
    """Return common gains per rad/s of the wheel, or None, and the reason."""
    if sets == "each" or len(own) == 1:
        return None, "one set of gains each"

    def on_worst_wheel(gains: Feedback) -> Robustness:
        """Return the robustness of gains on the wheel with the fewest motors that keep it."""
        found = [
            case.ensemble.assess(gains.scaled(1 / case.problem.loop.gear_ratio))
            for case in cases.values()
        ]
        return min(found, key=lambda one: one.holds)

    best: tuple[float, Feedback] | None = None
    for wheel, one in own.items():
        candidate = one.feedback.scaled(cases[wheel].problem.loop.gear_ratio)
        shared, factor, _ = back_off(on_worst_wheel, candidate)
        if factor == 0.0:
            continue
        loss = max(other.feedback.i * other.loop.gear_ratio / shared.i for other in own.values())
        if best is None or loss < best[0]:
            best = loss, shared
    if best is None:
        if sets == "one":
            raise DesignError(
                "no set of gains keeps the required margins on all wheels: the motors differ too "
                "much; ask for one set each, or for smaller margins"
            )
        return None, "one set of gains each: no set keeps the margins on all wheels"
    loss, shared = best
    if sets == "auto" and loss > MAX_REJECTION_LOSS:
        return None, (
            f"one set of gains each: with a common set a load would slow a wheel {loss:.2f} times "
            "as much"
        )
    more = 100 * (loss - 1)
    return shared, f"one set of gains for all: a load slows no wheel by over {more:.0f} % more"
