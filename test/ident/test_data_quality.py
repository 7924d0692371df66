# SPDX-License-Identifier: Apache-2.0
"""Bad data are refused or reported with a reason, never estimated silently."""

from dataclasses import replace

import motors
import numpy as np
import pytest
from scipy.signal import lfilter

from smp_motor_ident.errors import InsufficientExcitationError, SignalError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.infer.planning import what_next
from smp_motor_ident.quality.screen import screen_records
from smp_motor_ident.quality.units import refuse_mixed_time_units
from smp_motor_ident.record import Record

GOOD = motors.record("rear_left", seconds=4.0)
N = len(GOOD)


def still(value):
    return motors.record("rear_left", seconds=4.0, voltage=np.full(N, value))


def alternate(values):
    return np.where(np.arange(N) % 300 < 180, np.nan, values)


BAD = {
    "no excitation": (still(0.0), InsufficientExcitationError, "no excitation"),
    "constant input": (still(6.0).slice(N // 2, N), InsufficientExcitationError, "constant at 6 V"),
    "too short": (GOOD.slice(0, 30), InsufficientExcitationError, "too short, 30 samples"),
    "saturated velocity": (replace(GOOD, count=None, velocity=np.clip(GOOD.velocity, -150, 150)),
                           SignalError, "saturated sensor, velocity"),
    "saturated current": (replace(GOOD, current=np.clip(GOOD.current, -0.8, 0.8)),
                          SignalError, "saturated sensor, current"),
    "dead encoder": (replace(GOOD, count=np.zeros(N, int)), SignalError, "dead encoder"),
    "encoder dies": (replace(GOOD, velocity=None, count=GOOD.count[np.arange(N).clip(max=N // 2)]),
                     SignalError, "dead encoder"),
    "swapped leads": (replace(GOOD, count=-GOOD.count, velocity=-GOOD.velocity),
                      SignalError, "swapped sign, speed"),
    "swapped channels": (replace(GOOD, count=-GOOD.count), SignalError, "swapped sign"),
    "wrong gear ratio": (replace(GOOD, velocity=GOOD.velocity * 0.5),
                         SignalError, "wrong gear ratio"),
    "NaN gaps": (replace(GOOD, count=None, velocity=alternate(GOOD.velocity)),
                 SignalError, "NaN in 60 %"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_data_are_refused_with_a_reason(name):
    recording, error, words = BAD[name]
    with pytest.raises(error, match=words) as caught:
        estimate(recording)
    assert caught.value.exit_code == 1
    assert "\n" not in str(caught.value)


def test_speed_uncorrelated_with_voltage_is_refused():
    noise = 50 * np.random.default_rng(0).standard_normal(N)
    with pytest.raises((SignalError, InsufficientExcitationError)):
        estimate(replace(GOOD, count=None, velocity=noise).slice(0, N // 2))


def test_clipped_current_under_a_two_level_command_is_refused_as_saturated():
    random = np.repeat(np.sign(np.random.default_rng(2).standard_normal(N // 40)), 40) * 8.0
    good = motors.record("rear_left", voltage=random, seconds=4.0)
    with pytest.raises(SignalError, match="saturated sensor, current"):
        estimate(replace(good, current=np.clip(good.current, -0.6, 0.6)))


@pytest.mark.parametrize("late", [0, 2])
def test_steady_speed_at_its_quantisation_is_not_refused_as_saturated(late):
    """The rounded speed settles to one level within 40 samples of each step."""
    level = np.repeat([3.0, 8.0, 5.0, 8.0, 2.0, 8.0, 0.0, 6.0], 40)
    speed = lfilter([0.5], [1.0, -0.5], np.roll(level, late) * 25.0)
    screen_records([Record("motor", np.arange(320) / 50.0, level, velocity=np.round(speed, 1))])


def test_noise_peak_held_for_six_rows_is_not_refused_as_saturated():
    """A board with a slow speed update repeats a noise peak six times."""
    level = np.repeat([3.0, 8.0, 5.0, 2.0, 6.0], 60) + np.linspace(0.0, 1.0, 300)
    speed = 25.0 * level + np.random.default_rng(4).normal(0.0, 2.0, 300)
    speed[100:106] = speed.max() + 20.0
    screen_records([Record("motor", np.arange(300) / 100.0, level, velocity=speed)])


def test_steady_speed_under_one_voltage_level_is_not_refused_as_saturated():
    speed = np.round(8.0 * 25.0 * (1 - np.exp(-np.arange(300) / 30)), 1)
    level = np.r_[np.zeros(20), np.full(280, 8.0)]
    screen_records([Record("motor", np.arange(300) / 100.0, level, velocity=speed)])


def test_constant_voltage_with_measurement_noise_is_refused_as_constant():
    noise = 0.01 * np.random.default_rng(3).standard_normal(N)
    with pytest.raises(InsufficientExcitationError, match="constant at 6"):
        estimate(motors.record("rear_left", seconds=4.0, voltage=6.0 + noise).slice(N // 2, N))


def test_current_with_swapped_sign_is_excluded_and_reported():
    result = estimate(replace(GOOD, current=-GOOD.current))
    (said,) = [f for f in result.findings if f.code == "current_left_out"]
    assert said.severity == "warning" and "swapped sign, current" in said.message
    assert result.value("dc_gain") == pytest.approx(motors.truth("rear_left", 0.3)["dc_gain"], 1e-3)


def test_a_small_offset_of_the_current_is_removed_and_reported():
    result = estimate(replace(GOOD, current=GOOD.current + 0.05))
    assert any(f.code == "current_offset" for f in result.findings)
    assert result.value("resistance") == pytest.approx(3.2843, rel=2e-3)  # 5 of its std


def test_filtered_speed_is_not_refused_as_wrong_gear_ratio():
    """The lag is 30 ms, the time constant 50 ms: about 0.8 of the speed remains."""
    slow = lfilter([1 / 7], [1.0, -6 / 7], GOOD.velocity)  # 5 ms of 35
    screen_records([replace(GOOD, current=None, velocity=slow)])


@pytest.mark.parametrize("offset", [0.0, 1.2])
def test_speed_noise_does_not_bias_the_current_offset(offset):
    """Noise attenuates the speed coefficient, which in one direction looks like an offset."""
    rng = np.random.default_rng(1)
    volts = np.repeat(rng.uniform(2.0, 10.0, 400), 20)
    true = motors.record("rear_left", voltage=volts, seconds=20.0)
    noise = 2.0 * true.velocity.std() * rng.standard_normal(volts.size)
    noisy = replace(true, count=None, velocity=true.velocity + noise, current=true.current + offset)
    said = [f for f in estimate(noisy).findings if f.code == "current_left_out"]
    assert any("current has an offset of 1.1" in f.message for f in said) == (offset > 0)


def test_nan_gaps_in_the_current_are_excluded_and_reported():
    amps = np.where(np.arange(N) % 300 < 60, np.nan, GOOD.current)
    result = estimate(replace(GOOD, current=amps))
    assert any(f.code == "samples_lost" for f in result.findings)
    assert result.value("resistance") == pytest.approx(3.2843, rel=2e-3)


def test_proposed_excitation_stays_within_the_recorded_voltage():
    poor = motors.record("rear_left", current=False, amplitude=5.0)
    hardware = replace(poor.hardware, supply_voltage=None)
    proposal = what_next(estimate(replace(poor, hardware=hardware)))
    assert proposal.amplitude <= 5.0


@pytest.mark.parametrize("sign", [1, -1])
def test_motor_below_breakaway_is_refused_as_standing_despite_sensor_offset(sign):
    volts = np.where(np.arange(N) < N // 4, 0.002, 1.1 * sign)
    offset = replace(GOOD, count=None, current=None, voltage=volts, velocity=np.full(N, 0.13))
    with pytest.raises(SignalError, match=r"standing motor.*no excitation above friction"):
        estimate(offset)


@pytest.mark.parametrize(
    ("speed", "angle", "words"),
    [
        (30 / np.pi, 1.0, "speed is in rpm, the other in radians"),
        (30 / np.pi, 0.5 / np.pi, "speed is in rpm, the other in turns"),
        (1.0, 180 / np.pi, "angle is in degrees, the other in radians"),
        (1.7, 1.0, "wrong gear ratio"),
    ],
)
def test_unit_mismatch_between_speed_and_angle_is_named(speed, angle, words):
    turned = np.cumsum(GOOD.velocity) * np.median(np.diff(GOOD.time))
    mixed = replace(GOOD, count=None, velocity=speed * GOOD.velocity, position=angle * turned)
    with pytest.raises(SignalError, match=words):
        screen_records([mixed])


def _coarse(record: Record, counts: float, samples: int) -> Record:
    """Return a record with speed from a difference of counts over some samples."""
    turned = np.cumsum(record.velocity) * record.sample_time
    count = np.floor(turned / (2 * np.pi) * counts)
    moved = count - np.concatenate([np.full(samples, count[0]), count[:-samples]])
    speed = moved * 2 * np.pi / counts / samples / record.sample_time
    return replace(record, velocity=speed, count=None, position=None)


def test_low_fit_due_to_coarse_counts_is_not_unreliable():
    fine = motors.record("rear_left", current=False, seconds=20.0, kinds=("fourier", "square"))
    coarse = _coarse(replace(fine, count=None), 2.0, 4)
    found = estimate(coarse)  # the quantum is 157 rad/s, the largest speed 300 rad/s
    assert found.fit_percent.estimation < 70  # below the limit for an unexplained speed
    assert not found.unreliable
    motors.check(found, motors.truth("rear_left", 0.3), ["dc_gain"])


def test_coarse_speed_unrelated_to_the_voltage_is_refused_or_unreliable():
    fine = motors.record("rear_left", current=False, seconds=8.0, kinds=("fourier", "square"))
    coarse = _coarse(replace(fine, count=None), 2.0, 4)
    rng = np.random.default_rng(4)
    other = np.repeat(rng.uniform(-10.0, 10.0, len(fine) // 40 + 1), 40)[: len(fine)]
    try:
        found = estimate(replace(coarse, voltage=other))
    except (InsufficientExcitationError, SignalError):
        return
    assert found.unreliable


def test_record_with_time_in_milliseconds_among_others_is_refused_by_name():
    milliseconds = replace(GOOD, time=1000.0 * GOOD.time, source="third.csv")
    for others in ([GOOD], [GOOD, GOOD]):
        with pytest.raises(SignalError, match=r"third\.csv: a sample every 5 s, 1000 times.*:ms"):
            screen_records([*others, milliseconds])
    refuse_mixed_time_units(
        [GOOD, replace(GOOD, time=100.0 * GOOD.time)]
    )  # 2 Hz and 200 Hz are plausible


def test_sign_check_ignores_records_at_rest():
    """At rest the speed is a sensor offset, which may oppose the voltage."""
    still = replace(GOOD, voltage=np.full(N, 0.4), count=None, velocity=np.full(N, -1e-4))
    screen_records([replace(GOOD, count=None), still])


def make_record(**changes):
    time = np.arange(6) * 0.01
    signals = {"wheel": "front_left", "time": time, "voltage": np.ones(6), "velocity": time * 3}
    return Record(**{**signals, **changes})


def test_duration_and_sample_time_come_from_the_time_axis():
    record = make_record()
    assert len(record) == 6
    # Sums of 0.01 in floating point: exact to a few units in the last place.
    assert record.duration == pytest.approx(0.05, rel=1e-12)
    assert record.sample_time == pytest.approx(0.01, rel=1e-12)


def test_signals_are_kept_contiguous_and_as_float():
    record = make_record(velocity=np.arange(12)[::2])
    assert record.velocity.dtype == np.float64
    assert record.velocity.flags["C_CONTIGUOUS"]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"time": np.array([0, 0.01, 0.01, 0.02, 0.03, 0.04])}, "sample 2"),
        ({"time": np.array([0.0])}, "at least 2 samples"),
        ({"voltage": np.ones(5)}, "voltage has 5 samples"),
        ({"voltage": np.array([1, 1, np.nan, 1, 1, 1])}, r"voltage is nan at t = 0\.02"),
        ({"velocity": None}, "neither velocity, position nor encoder counts"),
        ({"count": np.arange(3)}, "count has 3 samples"),
        ({"starts": (0, 4, 4)}, "must increase"),
        ({"starts": (1,)}, "must increase from 0"),
    ],
)
def test_contradictory_signals_are_refused_by_name(changes, named):
    with pytest.raises(SignalError, match=named):
        make_record(source="bench.mcap", **changes)


@pytest.mark.parametrize("name", ["current", "velocity", "position"])
def test_an_infinite_measurement_counts_as_missing(name):
    # Firmware that divides by the time between pulses sends them.
    measured = np.array([0.0, 1.0, np.inf, -np.inf, np.nan, 5.0])
    record = make_record(**{"velocity": np.ones(6), name: measured})
    lost = [False, False, True, True, True, False]
    np.testing.assert_array_equal(np.isnan(getattr(record, name)), lost)
    assert np.isinf(measured[2])  # the caller's array is as it was


def test_slice_starts_at_time_zero_and_keeps_inner_segments():
    part = make_record(starts=(0, 2, 4), count=np.arange(6)).slice(1, 5)
    assert part.starts == (0, 1, 3)
    assert part.time[0] == 0
    np.testing.assert_array_equal(part.count, [1, 2, 3, 4])
