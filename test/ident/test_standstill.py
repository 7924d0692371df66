# SPDX-License-Identifier: Apache-2.0
"""A standing encoder repeats one error; taken for news it would make intervals too narrow."""

import numpy as np
import pytest

from smp_motor_ident.errors import InsufficientExcitationError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.fit.data import prepare
from smp_motor_ident.quality.resolution import REST
from smp_motor_ident.record import Hardware, Record


def counted(counts: list[int], starts: tuple[int, ...] = (0,)) -> Record:
    count = np.array(counts)
    time = 0.01 * np.arange(count.size)
    hardware = Hardware(1.0, 500.0)
    return Record("w", time, np.ones(count.size), count=count, starts=starts, hardware=hardware)


def kept(record: Record) -> list[int]:
    """Indices at which the angle is an output."""
    return [int(k) for k in np.flatnonzero(np.isfinite(prepare([record], False).motion))]


def test_the_middle_sample_of_a_standstill_is_kept():
    moving, still = list(range(20)), [20] * 31
    assert kept(counted([*moving, *still, *range(21, 30)])) == [*range(20), 35, *range(51, 60)]


def test_a_segment_that_begins_at_rest_keeps_its_first_sample():
    counts = [0] * 30 + list(range(1, 11)) + [7] * 30 + list(range(8, 12))
    assert kept(counted(counts, (0, 40))) == [0, *range(30, 40), 40, *range(70, 74)]


def test_slow_motion_is_unchanged():
    slow = [k // (REST - 1) for k in range(90)]
    assert kept(counted(slow)) == list(range(90))


@pytest.mark.parametrize("rest", [REST, 10 * REST])
def test_how_long_it_stands_adds_nothing(rest):
    assert len(kept(counted([0, 1, 2, *[3] * rest, 4, 5]))) == 6


def test_a_motor_at_rest_with_a_noisy_angle_is_refused_despite_its_current():
    resistance, inductance, step = 4.0, 0.02, 0.01
    rng = np.random.default_rng(3)
    voltage = np.repeat(rng.choice([-0.1, 0.0, 0.1], 40), 15)
    decay = np.exp(-step * resistance / inductance)
    current = np.zeros(voltage.size)
    for k in range(1, voltage.size):  # a row's voltage ran before it
        current[k] = decay * current[k - 1] + (1 - decay) * voltage[k] / resistance
    position = 1e-3 * rng.standard_normal(voltage.size)
    noisy = current + 1e-4 * rng.standard_normal(voltage.size)
    record = Record("w", step * np.arange(voltage.size), voltage, noisy, position=position)
    with pytest.raises(InsufficientExcitationError, match="the motor is at rest"):
        estimate(record)
