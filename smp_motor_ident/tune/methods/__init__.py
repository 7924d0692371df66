# SPDX-License-Identifier: Apache-2.0
"""Provide the tuning methods under one interface."""

from smp_motor_ident.tune.methods.margin import MARGIN
from smp_motor_ident.tune.methods.rules import SIMC, TYREUS_LUYBEN, ZIEGLER_NICHOLS

_ALL = MARGIN, SIMC, ZIEGLER_NICHOLS, TYREUS_LUYBEN
METHODS = {method.name: method for method in _ALL}  # every method by its name
