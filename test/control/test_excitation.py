# SPDX-License-Identifier: Apache-2.0
"""Excitation signals: bounded, incommensurate with the sampling, and broadband."""

import math

import numpy as np
import pytest

from smp_motor_control.errors import ParameterError
from smp_motor_control.excitation import (
    SIGNALS,
    Fourier,
    Ramp,
    Sine,
    Square,
    draw_multisine,
)

RATES = (50.0, 100.0, 200.0, 500.0, 1000.0)


@pytest.mark.parametrize("name", SIGNALS)
def test_signal_stays_within_its_amplitude_and_is_zero_before_it_starts(name):
    signal = SIGNALS[name](amplitude=7.0)
    time = np.linspace(0.0, 300.0, 300_001)
    assert np.max(np.abs(signal(time))) <= 7.0
    assert signal(-1.0) == 0.0 and signal(math.nan) == 0.0
    assert signal(12.34) == signal(np.array([12.34]))[0]


@pytest.mark.parametrize("name", SIGNALS)
def test_signal_has_zero_mean(name):
    signal = SIGNALS[name](amplitude=1.0)
    # Over 500 s random holds of 1 s average to 0.026 (one sigma); the rest averages better.
    assert abs(np.mean(signal(np.arange(0.0, 500.0, 0.005)))) < 0.08


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("kind", [Sine, Square])
def test_period_is_incommensurate_with_sample_interval(kind, rate):
    # Samples of a wave commensurate with the sampling cover few phases.
    phase = (np.arange(4000) / rate * math.sqrt(1.05)) % 1.0
    spacing = np.diff(np.sort(phase))
    assert spacing.max() < 4e-3
    assert np.unique(np.round(kind(amplitude=1.0)(np.arange(4000) / rate), 9)).size >= 2


def test_tones_are_incommensurate_and_span_the_range():
    f, _, _ = draw_multisine(lowest=0.1, highest=20.0, tones=24, seed=0)
    # Irrational places near the nominal ends: within 2 % of them.
    assert f[0] == pytest.approx(0.1, rel=0.02) and f[-1] == pytest.approx(20.0, rel=0.02)
    assert np.all(np.diff(f) > 0)
    ratios = (f[:, None] / f[None, :])[~np.eye(f.size, dtype=bool)]
    # No two tones share a period of fewer than 13 cycles.
    for whole in range(1, 13):
        assert np.min(np.abs(ratios * whole - np.round(ratios * whole))) > 1e-5


def test_multisine_has_low_crest_factor():
    v = Fourier(amplitude=1.0)(np.arange(0.0, 60.0, 0.002))
    assert np.max(np.abs(v)) / np.std(v) < 2.4


def test_signals_of_different_seeds_are_uncorrelated():
    time = np.arange(0.0, 120.0, 0.005)
    one, two = (Fourier(amplitude=1.0, seed=k)(time) for k in (0, 1))
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.1


def test_signal_fades_in_and_ends_at_its_duration():
    signal = Ramp(amplitude=5.0, period=1.0, duration=10.0, fade=1.0)
    time = np.linspace(0.0, 12.0, 12_001)
    v = signal(time)
    assert np.all(v[time >= 10.0] == 0.0) and np.max(np.abs(v)) <= 5.0
    assert np.max(np.abs(v[time < 0.1])) <= 0.5


@pytest.mark.parametrize(
    "make",
    [
        lambda: Sine(amplitude=-1.0),
        lambda: Sine(amplitude=math.nan),
        lambda: Sine(amplitude=1.0, frequency=0.0),
        lambda: Fourier(amplitude=1.0, lowest=5.0, highest=1.0),
        lambda: Fourier(amplitude=1.0, tones=1),
        lambda: Sine(amplitude=1.0, duration=0.0),
        lambda: Sine(amplitude=1.0, duration=1.0, fade=0.6),
    ],
)
def test_invalid_signal_parameters_are_refused(make):
    with pytest.raises(ParameterError):
        make()
