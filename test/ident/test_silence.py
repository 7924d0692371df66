# SPDX-License-Identifier: Apache-2.0
"""A silent sensor is dead only if the voltage would have moved it."""

from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.errors import SignalError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.quality.silence import refuse_silent_sensor

RATE = 2000.0
TIME = np.arange(int(10 * RATE)) / RATE
CHIRP = 10.0 * np.sin(2 * np.pi * (0.3 * TIME + 10.0 * TIME**2))  # to 200 Hz


def make_coarse_record(signal, volts=CHIRP, rate=RATE):
    """Return a record of one signal, of an encoder of 50 steps a turn."""
    whole = motors.record("rear_left", current=False, voltage=volts, rate=rate)
    count = whole.count // 10
    speed = np.diff(count, prepend=0) * (2 * np.pi / 50 * rate)
    values = {"count": count, "position": count * (2 * np.pi / 50), "velocity": speed}
    return replace(whole, **{**dict.fromkeys(values), signal: values[signal]})


def disconnect_sensor(record, signal, share):
    """Return a record whose sensor is disconnected after ``share`` of the rows."""
    row = np.arange(len(record))
    off = row > share * len(record)
    values = getattr(record, signal)
    kept = 0.0 if signal == "velocity" else values[np.argmax(off)]
    return replace(record, **{signal: np.where(off, kept, values).astype(values.dtype)})


@pytest.mark.parametrize("signal", ["count", "position", "velocity"])
def test_silence_in_a_chirp_beyond_the_bandwidth_is_not_a_dead_encoder(signal):
    alive = make_coarse_record(signal)
    values = getattr(alive, signal)
    assert np.ptp(values[int(0.85 * len(values)) :]) == 0.0  # silent although the motor swings
    refuse_silent_sensor(alive, "record")


@pytest.mark.parametrize("signal", ["count", "position", "velocity"])
@pytest.mark.parametrize("kind", ["chirp", "sine", "square", "fourier"])
def test_disconnected_encoder_is_refused_as_dead(signal, kind):
    if kind == "chirp":
        whole, shares = make_coarse_record(signal), [0.1]
    else:
        volts = motors.excitation(np.arange(2000) / 200.0, kind, 10.0)
        whole, shares = make_coarse_record(signal, volts, 200.0), [0.2, 0.5, 0.85]
        refuse_silent_sensor(whole, "record")
    for share in shares:
        with pytest.raises(SignalError, match=f"dead encoder, the {signal} stays"):
            refuse_silent_sensor(disconnect_sensor(whole, signal, share), "record")


@pytest.mark.parametrize("signal", ["count", "velocity"])
def test_speed_below_the_sensor_resolution_is_not_a_dead_sensor(signal):
    """A speed quantised to 60 rad/s, or counts of the same motor, under a chirp."""
    record = make_coarse_record(signal)
    speed = np.gradient(motors.record("rear_left", voltage=CHIRP, rate=RATE).count * 0.01257, TIME)
    if signal == "velocity":
        slow = np.convolve(speed, np.ones(20) / 20, "same")
        record = replace(record, velocity=60.0 * np.round(slow / 60.0))
    refuse_silent_sensor(record, "record")


@pytest.mark.parametrize("wheel", ["front_left", "front_right", "rear_left", "rear_right"])
def test_a_motor_stopped_by_friction_in_a_fast_chirp_is_not_a_dead_encoder(wheel):
    volts = 10.0 * np.sin(2 * np.pi * (0.3 * TIME + 5.0 * TIME**2))
    stops = motors.record(wheel, current=False, voltage=volts, rate=RATE, static_voltage=2.0)
    assert np.ptp(stops.count[int(0.8 * len(stops)) :]) == 0
    refuse_silent_sensor(replace(stops, velocity=None), "record")


def test_a_standstill_at_the_end_of_a_run_does_not_affect_the_next():
    volts = motors.excitation(np.arange(2000) / 200.0, "sine", 10.0)
    whole = make_coarse_record("count", volts, 200.0)
    stands = (np.arange(2000) >= 850) & (np.arange(2000) < 1150)
    kept = np.where(stands, whole.count[850], whole.count).astype(np.int64)
    with pytest.raises(SignalError, match="dead encoder"):
        refuse_silent_sensor(replace(whole, count=kept), "record")
    refuse_silent_sensor(
        replace(whole, count=kept, starts=(0, 1000)), "two runs"
    )  # 150 rows each: too few


@pytest.mark.parametrize("span", [(800, 1200), (500, 1400)])
def test_temporarily_blocked_motor_is_estimated_from_the_other_samples(span):
    """Blocked for a fifth and for nearly half of the record."""
    volts = motors.excitation(np.arange(2000) / 200.0, "fourier", 10.0)
    whole = motors.record("rear_left", current=False, voltage=volts, rate=200.0)
    whole = replace(whole, velocity=None)
    a, b = span
    stays = whole.count[a]
    after = whole.count[b:] - whole.count[b] + stays
    stands = np.concatenate([whole.count[:a], np.full(b - a, stays), after])
    found, plain = estimate(replace(whole, count=stands)), estimate(whole)
    assert not found.unreliable
    (said,) = [f for f in found.findings if f.code == "blocked"]
    assert said.evidence["begin"] == pytest.approx(a / 200.0, abs=0.02)
    assert said.evidence["end"] == pytest.approx(b / 200.0, abs=0.02)
    for name in ("dc_gain", "time_constant", "static_voltage"):
        one, other = found.combinations[name], plain.combinations[name]
        assert abs(one.value - other.value) < 4 * one.std < 0.2 * one.value, name
