"""Slower observers move the numbers where what was taken for torque noise is none."""

from __future__ import annotations

from dataclasses import replace

import motors
import numpy as np
import pytest
from scipy.signal import lfilter

from smp_motor_ident.diagnosis.observers import moved_by_slower
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.likelihood.experiments import Experiments, prepare
from smp_motor_ident.model.structures import SecondOrder


def fitted(share: float, seed: int) -> tuple[Experiments, Fit]:
    """A load that fluctuates; a share of the voltage's slow part (1 s) was not recorded."""
    made = motors.record(
        "rear_left", current=False, torque_noise=0.5, static_voltage=0.0, seed=seed, seconds=20.0
    )
    a = float(np.exp(-np.median(np.diff(made.time))))
    slow = lfilter([1 - a], [1.0, -a], made.voltage)
    record = replace(made, voltage=made.voltage - share * slow, velocity=None)
    data = prepare([record], False)
    fit = initial_fit(data, SecondOrder(friction="none"), Options())
    assert fit is not None and fit.noise_ratio > 0
    return data, fit


@pytest.mark.parametrize("seed", range(4))
def test_a_load_that_fluctuates_is_the_same_to_every_observer(seed: int) -> None:
    # The level is one in a hundred for each of the records.
    assert not moved_by_slower(*fitted(0.0, seed)).any()


@pytest.mark.parametrize("seed", range(3))
def test_what_differs_between_slow_and_fast_shows_to_a_slower_observer(seed: int) -> None:
    data, fit = fitted(0.2, seed)
    moved = np.abs(moved_by_slower(data, fit)) / np.sqrt(np.diag(fit.covariance()))
    assert moved.max() > 1.5  # deviations: what is below half of one is not looked at


def test_without_torque_noise_there_is_one_observer_only() -> None:
    data, fit = fitted(0.2, 0)
    assert not moved_by_slower(data, replace(fit, gain=np.zeros_like(fit.gain))).any()
