# SPDX-License-Identifier: Apache-2.0
"""The live window: its samples, its record, and its conditions for an estimate."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from smp_motor_ident.bag.window import Window
from smp_motor_ident.live.demands import find_missing_excitation
from smp_motor_ident.record import Hardware

RATIO, COUNTS, STEP = 65.5, 500.0, 0.005
SECOND = 1_000_000_000
NOW = 10**9 * SECOND


def state(voltage, current, velocity, position, count):
    return SimpleNamespace(
        voltage=voltage, current=current, velocity=velocity, position=position, encoder_count=count
    )


def filled(seconds: float, voltage: object = None, length: float = 60.0) -> Window:
    """Return a window filled by a motor of 25 rad/s/V without lag."""
    window = Window("front_left", length)
    window.hardware = Hardware(RATIO, COUNTS, 16, 12.0)
    time = np.arange(round(seconds / STEP)) * STEP
    volts = (
        6 * np.sin(2 * np.pi * 0.83 * time) + 3 * np.sin(2 * np.pi * 2.3 * time)
        if voltage is None
        else np.broadcast_to(np.asarray(voltage, dtype=float), time.shape)
    )
    angle = np.cumsum(25 * volts) * STEP
    counts = np.floor(angle * COUNTS / (2 * np.pi)).astype(int)
    for t, v, a, c in zip(time, volts, angle, counts, strict=True):
        wrap_angle = (int(c) + 2**15) % 2**16 - 2**15
        window.add(NOW + round(1e9 * t), state(v, np.nan, 25 * v / RATIO, a / RATIO, wrap_angle))
    return window


def test_record_is_at_the_motor_shaft_with_counts_unwrapped():
    record = filled(20.0).record()
    assert record.current is None
    np.testing.assert_allclose(record.velocity, 25 * record.voltage, rtol=1e-12)
    assert np.abs(np.diff(record.count)).max() < 2**15
    # Counts and speed agree to one count per sample of quantisation.
    moved = np.diff(record.count) * 2 * np.pi / COUNTS / STEP
    assert np.abs(moved - record.velocity[1:]).max() < 2 * np.pi / COUNTS / STEP * 1.01


def test_voltages_equal_to_rounding_count_as_one_level():
    for volts in (12.0, -3.3, 1e-3):
        voltage = np.full(2000, volts)
        voltage[::7] = np.nextafter(volts, np.inf)
        lacks = find_missing_excitation(filled(10.0, voltage).record())
        assert "1 of 3 levels of voltage" in lacks


@pytest.mark.parametrize("volts", [np.nan, np.inf, -1e308, 1e308, 1e9])
def test_sample_with_impossible_voltage_is_discarded(volts):
    window = filled(20.0)
    before = len(window)
    window.add(NOW + 20 * SECOND, state(volts, np.nan, 0.0, 0.0, 0))
    assert len(window) == before and find_missing_excitation(window.record()) == []


def test_window_keeps_only_its_length():
    window = filled(300.0, length=10.0)
    record = window.record()
    assert record.duration == pytest.approx(10.0, abs=2 * STEP)  # whole samples


def test_gap_begins_a_segment_and_out_of_order_sample_is_discarded():
    window = filled(5.0)
    before = len(window)
    window.add(NOW + 2 * SECOND, state(1.0, np.nan, 0.0, 0.0, 0))
    assert len(window) == before
    for k in range(2):  # a single sample between gaps has no information
        window.add(NOW + 7 * SECOND + k * 5_000_000, state(1.0, np.nan, 0.0, 0.0, 0))
    record = window.record()
    assert record.starts == (0, before)


def test_delayed_samples_of_a_busy_machine_begin_no_segment():
    # Every fiftieth sample is taken six intervals late, and the next ones catch up.
    window = Window("front_left", 60.0)
    window.hardware = Hardware(RATIO, COUNTS, 16, 12.0)
    time = np.arange(2000) * STEP
    for k in range(50, 2000, 50):
        time[k : k + 8] = time[k] + 6 * STEP + np.arange(8) * STEP / 8
    for t in time:
        window.add(
            NOW + round(1e9 * t), state(3.0, 0.1, 75 / RATIO, 75 * t / RATIO, round(5968 * t))
        )
    record = window.record()
    assert record.starts == (0,)


def test_a_clock_that_was_set_back_clears_the_window():
    window = filled(5.0, length=3.0)
    window.add(NOW - 3600 * SECOND, state(1.0, np.nan, 0.0, 0.0, 0))
    assert len(window) == 1


def test_samples_without_voltage_are_left_out():
    window = filled(1.0)
    before = len(window)
    window.add(NOW + 50 * SECOND, state(np.nan, np.nan, 0.0, 0.0, 0))
    assert len(window) == before


def test_rich_excitation_meets_all_requirements():
    assert find_missing_excitation(filled(10.0).record()) == []


@pytest.mark.parametrize(
    ("seconds", "voltage", "word"),
    [
        (2.0, None, "of 5 s"),
        (10.0, 0.0, "turned for 0.0"),
        (10.0, 5.0, "levels of voltage"),
        (10.0, 5.0, "changes of voltage"),
        (10.0, 5.0, "backward 0 %"),
    ],
)
def test_missing_excitation_is_named(seconds, voltage, word):
    assert word in "; ".join(find_missing_excitation(filled(seconds, voltage).record()))


def test_missing_motor_state_is_reported():
    assert find_missing_excitation(Window("w", 5.0).record()) == ["no motor_state yet"]


def test_excitation_requirements_do_not_depend_on_the_speed_unit():
    record = filled(10.0).record()
    slow = replace(record, velocity=record.velocity * 1e-6, count=None)
    assert find_missing_excitation(slow) == find_missing_excitation(record) == []


def test_excitation_requirements_are_met_without_a_speed():
    record = filled(10.0).record()
    for way in ({"count": None}, {"position": None, "hardware": Hardware()}):
        assert find_missing_excitation(replace(record, velocity=None, **way)) == []
