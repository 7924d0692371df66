"""What is known of a motor that was fitted: its intervals, and how it changes meanwhile.

Derivation: docs/derivations.md, sections 9 and 13.
"""

from collections.abc import Sequence

from smp_motor_ident.diagnosis.limits import PROFILED
from smp_motor_ident.diagnosis.one_size import consider_weaker_side
from smp_motor_ident.diagnosis.stamps import clock_share
from smp_motor_ident.estimation.consider_covariance import (
    consider_bound,
    consider_clock,
    consider_drop,
    consider_filter,
    consider_friction,
    consider_left_out,
    consider_timing,
)
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.hold_choice import instant_deviation
from smp_motor_ident.estimation.profile import profiled
from smp_motor_ident.estimation.quantisation import widened
from smp_motor_ident.estimation.request import Request
from smp_motor_ident.estimation.segments import Change, heterogeneous
from smp_motor_ident.estimation.thinning import thinned
from smp_motor_ident.estimation.transients import widened_by_pieces
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.record import Record


def certain(
    final: Experiments,
    free: Fit,
    chosen: Fit,
    request: Request,
    group: Sequence[Record],
    hold: str,
) -> tuple[Fit, float, Change]:
    """Return the chosen fit with all of its uncertainty, and how the motor changes.

    ``free``: the same without what physics forbids.
    """
    few = thinned(final) if final.size > PROFILED.value else final
    chosen = profiled(few, widened_by_pieces(final, widened(final, chosen)), request.options)
    if "viscous_friction" not in request.known:
        chosen = consider_bound(free, chosen)
    timed = consider_timing(final, chosen, instant_deviation(group, hold))
    timed = consider_drop(final, consider_clock(final, timed, clock_share(group)))
    timed = consider_weaker_side(final, consider_filter(final, timed, request.options))
    chosen, friction_std = consider_friction(final, consider_left_out(final, timed))
    if request.driver is not None:
        chosen, friction_std = request.driver.widened(chosen, friction_std)
    chosen, change = heterogeneous(final, chosen)
    return chosen, friction_std, change
