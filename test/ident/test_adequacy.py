"""What a model lacks is named, with a test of a stated size; clean data are left in peace."""

from __future__ import annotations

from dataclasses import replace

import motors
import numpy as np

from smp_motor_ident.diagnosis import model_error
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


def test_an_effect_whose_shape_the_model_has_to_a_twentieth_is_not_tried() -> None:
    rng = np.random.default_rng(3)
    own, noise, error = rng.standard_normal((3, 4000))
    block = np.arange(4000) * 40 // 4000
    tried = {}
    for part in (0.05, 0.5):  # what is left of the column, of its size
        table = np.column_stack([error, own, own + part * noise])
        members = [(EFFECTS[0], (0,))]
        tried[part] = model_error._projected(table, 1, block, members, 1).members
    assert not tried[0.05]  # a friction curve is not known to 5 %
    assert tried[0.5]
