# SPDX-License-Identifier: Apache-2.0
"""Design gains for the sampled loop of an identified motor."""

from smp_motor_ident.tune.designer import Design, compare, design, recommend
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.methods import METHODS
from smp_motor_ident.tune.wheels import design_wheels

__all__ = [
    "METHODS",
    "Design",
    "Loop",
    "compare",
    "design",
    "design_wheels",
    "recommend",
]
