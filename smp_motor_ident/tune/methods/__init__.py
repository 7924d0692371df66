# SPDX-License-Identifier: Apache-2.0
"""Tuning methods, one idea a file, all behind one interface."""

from smp_motor_ident.tune.methods.margin import MARGIN
from smp_motor_ident.tune.methods.pole_placement import POLE_PLACEMENT
from smp_motor_ident.tune.methods.relay import RELAY
from smp_motor_ident.tune.methods.simc import SIMC
from smp_motor_ident.tune.methods.ziegler_nichols import TYREUS_LUYBEN, ZIEGLER_NICHOLS

METHODS = {
    method.name: method
    for method in (
        MARGIN,
        POLE_PLACEMENT,
        SIMC,
        ZIEGLER_NICHOLS,
        TYREUS_LUYBEN,
        RELAY,
    )
}
"""Every method by its name."""

__all__ = ["METHODS"]
