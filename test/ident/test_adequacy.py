"""What a model lacks is named, with a test of a stated size; clean data are left in peace."""

from __future__ import annotations

from dataclasses import replace

import motors
import numpy as np

from smp_motor_ident.diagnosis.effects import EFFECTS
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record


def commanded(dead: float = 0.0, top: float = np.inf) -> Record:
    """A Fourier voltage of which the motor gets less than the record says."""
    t = np.arange(4000) / 200.0
    asked = motors.independent.excitation(t, "fourier", 10.0)
    given = np.sign(asked) * np.clip(np.abs(asked) - dead, 0.0, top)
    made = motors.record("rear_left", current=False, voltage=given, seconds=20.0)
    return replace(made, voltage=asked)


def test_clean_data_show_no_effect() -> None:
    codes = {effect.code for effect in EFFECTS}
    for wheel, seed in (("rear_left", 1), ("front_right", 2)):
        found = estimate(motors.record(wheel, current=False, seconds=8.0, seed=seed)).findings
        assert not codes & {f.code for f in found if f.severity == "unreliable"}


def test_a_clipped_command_is_no_sound_result() -> None:
    found = [f for f in estimate(commanded(top=6.0)).findings if f.severity == "unreliable"]
    assert any(f.evidence.get("quantity") and "record" in f.advice for f in found)
