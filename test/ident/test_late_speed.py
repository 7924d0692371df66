"""A speed that comes late where the current does not: predicted exactly, and found."""

import independent
import motors
import numpy as np
import passes
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.physical import from_physical
from smp_motor_ident.model.structures import Electromechanical
from smp_motor_ident.record import Record
from smp_motor_ident.tune import motors as tuned

STEP = 5e-3
FINE = 50
WHEEL = "rear_left"


def late(lag: float, noise: float = 0.0, seconds: float = 10.0) -> Record:
    """Return a record of a motor of Table 1 whose speed, alone, is the one that was."""
    n = int(seconds / STEP)
    voltage = independent.excitation(np.arange(n) * STEP, "fourier", 10.0)
    held = np.concatenate([[voltage[0]], np.repeat(voltage[1:], FINE)])  # a row's ran before it
    t = np.arange(held.size) * STEP / FINE
    r, el, k, j, b = independent.TABLE_1[WHEEL]
    out = independent.simulate(t, held, r, el, k, j, b, 0.3 * k / r, np.zeros(t.size), 4)
    rng = np.random.default_rng(3)
    speed = np.interp(t[::FINE] - lag, t, out[:, 1]) + noise * rng.standard_normal(n)
    amps = out[::FINE, 0] + 0.01 * rng.standard_normal(n)
    return Record("motor", t[::FINE], voltage, amps, speed, source="bag")


@pytest.mark.parametrize("lag", [0.1 * STEP, STEP, 7.3 * STEP])
def test_prediction_is_the_speed_that_was(lag):
    passes.assert_predicts(late(lag), Electromechanical(window=True, late=True), lag)


@pytest.mark.parametrize("lag", [0.1 * STEP, 1.3 * STEP, 7.3 * STEP])  # between its bends
def test_gradient_is_that_of_finite_differences(lag):
    structure = Electromechanical(friction="none", window=True, late=True)
    data = prepare([late(STEP, 1.0, 3.0)], True).measured_as(structure.speed)
    z = structure.complete(from_physical(*independent.TABLE_1[WHEEL])).with_(window=2 * lag)
    passes.assert_gradient(data, structure, z)


@pytest.mark.parametrize("lag", [0.6 * STEP, 2 * STEP, 7.3 * STEP])
def test_a_speed_that_is_later_than_the_current_moves_no_number(lag):
    found = estimate(late(lag, 0.1, 20.0))
    assert [f.severity for f in found.findings if f.code == "late_speed"] == ["note"]
    truth = motors.truth(WHEEL, 0.3) | {"delay": lag}
    for name in ("delay", "dc_gain", "time_constant", "resistance", "inductance"):
        q = (found.parameters | found.combinations)[name]
        assert abs(q.value - truth[name]) < 4 * q.std < 0.02 * truth[name], name
    assert not found.unreliable and "averaging_window" not in found.combinations
    # Gains are of that speed.
    assert tuned.motors_of(found).delay[0] == pytest.approx(lag, rel=0.05)


@pytest.mark.parametrize("share", [0.6, 0.8])
def test_a_mean_over_a_row_under_a_late_command_is_not_surely_a_late_speed(share):
    """To first order the speed comes half a row later than the current either way."""
    n, rows = 600, np.arange(600) * STEP
    voltage = 8.0 * np.sin(2 * np.pi * (0.3 * rows + 5.7 / 2 / rows[-1] * rows**2))
    fine = np.arange(n * FINE) * STEP / FINE
    taken = np.floor(fine / STEP - share + 1e-9).astype(int)  # rows from which the command is
    held = np.where(taken < 0, 0.0, voltage[np.maximum(taken, 0)])
    ran = np.concatenate([held[:1], held[:-1]])
    r, el, k, j, b = independent.TABLE_1[WHEEL]
    out = independent.simulate(fine, ran, r, el, k, j, b, 0.3 * k / r, np.zeros(fine.size), 4)
    rng = np.random.default_rng(3)
    count = np.floor(out[::FINE, 2] / (2 * np.pi / 4096) + rng.uniform())
    speed = np.diff(count, prepend=count[0]) * 2 * np.pi / 4096 / STEP
    amps = out[::FINE, 0] + 0.05 * rng.standard_normal(n)
    found = estimate(Record("motor", rows, voltage, amps, speed, source="bag"))
    q = found.combinations["time_constant"]
    assert abs(q.value - motors.truth(WHEEL, 0.3)["time_constant"]) < 4 * q.std < 0.01 * q.value
