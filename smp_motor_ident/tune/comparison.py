"""Methods side by side, and one of them recommended."""

import math
from collections.abc import Sequence
from typing import Any

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.case import COMMON
from smp_motor_ident.tune.designer import Design, design
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.methods import METHODS


def compare(
    estimate: Estimate, loop: Loop, methods: Sequence[str] | None = None, **targets: Any
) -> dict[str, Design | DesignError]:
    """Design by every method, for one table.

    Parameters
    ----------
    estimate, loop
        As for :func:`design`.
    methods : sequence of str or None
        Names; None takes all.
    **targets
        Each method is given those that it understands.

    Returns
    -------
    dict of str to Design or DesignError
        A method that cannot meet the demand is there as its error.
    """
    results: dict[str, Design | DesignError] = {}
    for name in METHODS if methods is None else methods:
        known = (*COMMON, *METHODS[name].targets)
        own = {key: value for key, value in targets.items() if key in known}
        try:
            results[name] = design(estimate, loop, name, **own)
        except DesignError as error:
            results[name] = error
    return results


def recommend(results: dict[str, Design | DesignError]) -> tuple[str, str]:
    """Choose among compared designs.

    Parameters
    ----------
    results : dict
        From :func:`compare`.

    Returns
    -------
    name : str
    reason : str
        One sentence.

    Raises
    ------
    DesignError
        When no method met the demand.
    """
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
