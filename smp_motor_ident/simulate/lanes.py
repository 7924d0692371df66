# SPDX-License-Identifier: Apache-2.0
"""Parameters of one lane of the simulation, by their place.  Neutral values leave no effect."""

from __future__ import annotations

import numpy as np

from smp_motor_control.arrays import Array

NAMES = (
    "te", "tm", "k", "be", "vc_plus", "vc_minus", "load",
    "sag", "drop", "current_limit", "decay", "free", "decline",
    "drag", "stribeck", "stribeck_speed", "friction_drift",
    "load_step", "load_step_at",
)  # fmt: skip
(TE, TM, K, BE, VC_PLUS, VC_MINUS, LOAD, SAG, DROP, CURRENT_LIMIT, DECAY, FREE, DECLINE,
 DRAG, STRIBECK, STRIBECK_SPEED, FRICTION_DRIFT, LOAD_STEP,
 LOAD_STEP_AT) = range(len(NAMES))  # fmt: skip
NEUTRAL: Array = np.zeros(len(NAMES))
NEUTRAL[CURRENT_LIMIT] = np.inf
NEUTRAL[[TM, K, STRIBECK_SPEED]] = 1.0
