"""What a compiled pass predicts of a speed behind its sensor, and the gradient of that."""

from __future__ import annotations

from dataclasses import replace

import independent
import numpy as np
import pytest

from smp_motor_ident.likelihood.experiments import Experiments, prepare
from smp_motor_ident.likelihood.noise import NoiseModel
from smp_motor_ident.likelihood.passes import gather
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.physical import from_physical
from smp_motor_ident.model.structures import Structure
from smp_motor_ident.record import Record


def assert_predicts(record: Record, structure: Structure, lag: float) -> None:
    """Assert that the speed of the rear left motor, with 0.3 V of friction, is the recorded one."""
    p = independent.TABLE_1["rear_left"]
    data = prepare([record], True).measured_as(structure.speed)
    data = replace(data, initial=np.zeros((1, 5)))
    z = structure.complete(from_physical(*p, 0.3 * p[2] / p[0])).with_(window=2 * lag)
    out = np.zeros((data.size, 3))
    gather(data, structure, z, data.initial, NoiseModel(), out, differentiate=False)
    # Where friction bends the speed between two samples, a parabola is off by that much.
    assert np.abs(out[:, 1] - record.velocity).max() < 2e-3 * np.ptp(record.velocity)
    assert np.median(np.abs(out[:, 1] - record.velocity)) < 2e-5 * np.ptp(record.velocity)


def assert_gradient(data: Experiments, structure: Structure, z: Coordinates) -> None:
    """Assert it by finite differences in each free coordinate, a window's in parts of its own."""
    matrix = structure.matrix
    gradient = gather(data, structure, z, data.initial).gradient[0]
    for j in range(matrix.shape[1]):
        step = 1e-6 * (0.5 * z.window if structure.free[j] == "window" else 1.0)
        up, down = (
            gather(data, structure, z.moved(way * step * matrix[:, j]), data.initial).cost[0]
            for way in (1, -1)
        )
        scale = np.abs(gradient[j])
        assert gradient[j] == pytest.approx(-0.5 * (up - down) / (2 * step), abs=1e-4 * scale)
