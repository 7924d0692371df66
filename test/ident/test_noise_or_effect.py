"""What a load that fluctuates would swallow is named, and a load that fluctuates is left alone."""

from __future__ import annotations

from dataclasses import replace

import independent
import motors
import numpy as np
import pytest

from smp_motor_ident.diagnosis.effects import EFFECTS
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record

STEP = 1 / 200


def dragged(share: float, seed: int = 3) -> Record:
    """Random steps of a motor with a drag that takes a share of what friction does at 8 V."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-10.0, 10.0, 40), 50)
    t = np.arange(voltage.size) * STEP
    r, el, k, j, b = independent.TABLE_1["rear_left"]
    fastest = 8.0 * k / (r * b + k * k)
    drag = share * (0.3 * k / r + b * fastest) / fastest**2
    load = np.zeros(t.size)
    for _ in range(12):  # the speed that the load itself slows
        out = independent.simulate(t, voltage, r, el, k, j, b, 0.3 * k / r, load, 50)
        middle = 0.5 * (out[:, 1] + np.concatenate([[0.0], out[:-1, 1]]))
        load = drag * middle * np.abs(middle)
    angle = np.round(out[:, 2], 6)
    amps = out[:, 0] + 0.01 * rng.standard_normal(t.size)
    made = motors.record("rear_left", voltage=voltage, seconds=5.0)
    return replace(made, count=None, position=angle, velocity=None, current=amps)


def findings(record: Record) -> dict[str, str]:
    """Return the severity of what real drives do that is spoken of."""
    codes = {effect.code for effect in EFFECTS}
    return {f.code: f.severity for f in estimate(record).findings if f.code in codes}


def test_a_drag_is_not_taken_for_a_load_that_fluctuates() -> None:
    assert findings(dragged(0.4)).get("drag") == "unreliable"
    assert "unreliable" not in findings(dragged(0.0)).values()


@pytest.mark.parametrize("seed", range(3))
def test_a_load_that_fluctuates_shows_no_effect(seed: int) -> None:
    made = motors.record("rear_left", current=bool(seed % 2), torque_noise=0.5, seed=seed)
    found = estimate(made).findings
    assert "torque_noise" in {f.code for f in found}
    assert "unreliable" not in {f.severity for f in found}
