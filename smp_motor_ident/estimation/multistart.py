"""Descents from several starts: a table says which, one loop tries them, one rule keeps the best.

Derivation: docs/derivations.md, section 10.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from smp_motor_ident.estimation.fit import Fit, Options, Start, solve
from smp_motor_ident.likelihood.experiments import Experiments

ALIKE = 0.5  # deviance by which two fits explain the data alike


@dataclass(frozen=True)
class Trial:
    """Other starts of a fit: what they are, whether it is their turn, and where they lie."""

    about: str
    applies: Callable[[Experiments, Fit], bool]
    starts: Callable[[Experiments, Fit, Options], Iterable[Start]]


def tried(
    data: Experiments,
    best: Fit,
    trials: Sequence[Trial],
    options: Options,
    passes: int = 30,
    tolerance: float = 1e-2,
) -> Fit:
    """Return the best of a fit and of the descents from other starts, one trial after the other."""
    structure = best.structure
    # A current may leave L and R so open that any place is near where a descent began.
    near = not structure.current
    for trial in trials:
        if not trial.applies(data, best):
            continue
        for start in trial.starts(data, best, options):
            begun = start.at(structure.complete(start.z))
            other = solve(
                data, structure, begun, options, passes, tolerance, best if near else None
            )
            best = other if better(other, best) else best
    return best


def better(one: Fit, other: Fit) -> bool:
    """Tell which of two fits to keep: the likelier; of two alike the one that claims less."""
    if one.deviance < other.deviance - ALIKE:
        return True
    free = one.structure.free
    if one.deviance > other.deviance + ALIKE or "vc_plus" not in free:
        return one.deviance < other.deviance
    i = free.index("vc_plus")
    mine, theirs = one.covariance()[i, i], other.covariance()[i, i]
    return bool(mine > 4 * theirs or (mine > theirs / 4 and one.deviance < other.deviance))
