"""What the intervals take up of a model that is not all of the motor, beside what is named."""

from collections.abc import Callable
from dataclasses import replace

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.command_jitter import jittered
from smp_motor_ident.diagnosis.observers import slower
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.quantities import Answer
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments

Said = tuple[Answer, dict[str, float]]
"""What is stated, and the weights of structures between which the data do not decide."""


def widened_by_misfit(
    data: Experiments,
    fit: Fit,
    possible: Array | None,
    said: Callable[[Fit], Said],
) -> tuple[Said, list[Finding]]:
    """Return what is stated with an effect that is possible and what two tests show, and say so.

    Where a number would be lost in an interval so wide, it stays as it is and is unreliable.
    """
    narrow = fit if possible is None else fit.along(possible)
    wide, slow = slower(data, narrow)
    wide, late = jittered(data, wide)
    before = said(narrow)
    if wide is narrow:
        return before, []
    after = said(wide)
    lost = [
        name
        for name, quantity in before[0].combinations.items()
        if quantity.value is not None and after[0].combinations[name].value is None
    ]
    if not lost:
        return after, [*slow, *late]
    words = f"; that leaves nothing of {' and '.join(lost)}, which the intervals do not cover"
    return before, [
        replace(f, severity="unreliable", message=f.message.partition(":")[0] + words)
        for f in (*slow, *late)
    ]
