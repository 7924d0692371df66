# SPDX-License-Identifier: Apache-2.0
"""The simulated motor with its driver and sensors, and the excitation signals sent to it."""

import dataclasses
import math
from pathlib import Path

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
from smp_motor_control.motor.file import Wiring, load_motors, parse_motors
from smp_motor_control.motor.friction import Motor
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings, Supply

ENTRY = load_motors(Path(__file__).parents[2] / "config" / "motors_paper.yaml")["rear_right"]
IDEAL = DriveSettings(command_timeout=math.inf)


def test_motor_rests_before_the_first_command():
    plant = DrivenMotor(ENTRY, DriveSettings(current_noise=0.0))
    sample = plant.sample(5.0)
    assert sample[:2] == (0.0, 0.0) and sample.encoder_count == 0 and plant.timed_out


def test_commands_act_from_their_time_of_arrival():
    plant, motor = DrivenMotor(ENTRY, IDEAL), Motor(ENTRY.parameters)
    plant.command(0.0123, 6.0)
    plant.command(0.0177, -3.0)
    sample = plant.sample(0.02)
    for voltage, dt in ((0.0, 0.0123), (6.0, 0.0054), (-3.0, 0.0023)):
        motor.step(voltage, dt)
    # The same steps up to the rounding of times.
    assert plant.motor.speed == pytest.approx(motor.speed, rel=1e-9)
    assert sample.voltage == pytest.approx((6.0 * 0.0054 - 3.0 * 0.0023) / 0.02, rel=1e-9)


def test_irregular_sampling_does_not_change_the_motion():
    plants = [DrivenMotor(ENTRY, IDEAL) for _ in range(2)]
    draw = np.random.default_rng(3)
    for k in range(100):
        for plant in plants:
            plant.command(0.01 * k, 8.0 * math.sin(k))
        for extra in sorted(draw.uniform(0.01 * k, 0.01 * (k + 1), 5)):
            plants[1].sample(float(extra))
        for plant in plants:
            plant.sample(0.01 * (k + 1))
    assert plants[0].motor.speed == pytest.approx(plants[1].motor.speed, rel=1e-9)


def test_voltage_goes_to_zero_exactly_at_the_time_out():
    plant = DrivenMotor(ENTRY, DriveSettings(command_timeout=0.2))
    plant.command(0.0, 10.0)
    assert plant.sample(0.3).voltage == pytest.approx(10.0 * 0.2 / 0.3, rel=1e-12)
    assert plant.timed_out and plant.sample(0.4).voltage == 0.0
    plant.command(0.4, 5.0)
    assert plant.sample(0.5).voltage == pytest.approx(5.0, rel=1e-12)


@pytest.mark.parametrize("voltage", [math.nan, math.inf, -math.inf])
def test_non_finite_command_gives_zero_volts(voltage):
    plant = DrivenMotor(ENTRY, IDEAL)
    plant.command(0.0, 10.0)
    plant.sample(0.1)
    assert not plant.command(0.1, voltage)
    assert plant.sample(0.2).voltage == 0.0


def test_voltage_is_limited_by_supply_and_rounded_to_pwm_steps():
    plant = DrivenMotor(ENTRY, dataclasses.replace(IDEAL, pwm_steps=8))
    plant.command(0.0, 100.0)
    assert plant.sample(0.01).voltage == pytest.approx(12.0)
    plant.command(0.01, -4.0)
    assert plant.sample(0.02).duty == -0.375  # 2.67 of 8 steps


def test_battery_sags_under_the_current_of_all_motors():
    supply = Supply(12.0, resistance=0.3)
    plants = [DrivenMotor(ENTRY, IDEAL, supply) for _ in range(2)]
    for plant in plants:
        plant.command(0.0, 12.0)
        plant.load(0.0, 65.5 * 0.05)
    for k in range(1, 400):
        samples = [plant.sample(0.005 * k) for plant in plants]
    expected = 12.0 - 0.3 * sum(plant.motor.current for plant in plants)
    # Voltage is held over an interval in which the current still changes a little.
    assert samples[0].voltage == pytest.approx(expected, abs=1e-3)
    assert samples[0].voltage < 11.5


def test_motor_delay_postpones_commands():
    plant = DrivenMotor(dataclasses.replace(ENTRY, delay=0.01), IDEAL)
    plant.command(0.0, 6.0)
    assert plant.sample(0.01).voltage == 0.0
    assert plant.sample(0.02).voltage == pytest.approx(6.0, rel=1e-9)


def test_current_is_nan_without_a_sensor_and_noisy_with_one():
    blind = DrivenMotor(ENTRY, dataclasses.replace(IDEAL, current_sensor=False))
    assert math.isnan(blind.sample(0.01).current)
    noisy = DrivenMotor(ENTRY, dataclasses.replace(IDEAL, current_noise=0.05), seed=1)
    currents = [noisy.sample(0.01 * k).current for k in range(1, 2001)]
    # Standard error of the deviation of 2000 draws: 1.6 %.
    assert np.std(currents) == pytest.approx(0.05, rel=0.07)


def test_reported_speed_is_quantised_to_counts_around_true_speed():
    plant = DrivenMotor(ENTRY, IDEAL)
    plant.command(0.0, 8.0)
    for k in range(1, 300):
        sample = plant.sample(0.005 * k)
    quantum = ENTRY.gearbox.to_wheel(ENTRY.encoder.angle_per_count / 0.005)
    true = ENTRY.gearbox.to_wheel(plant.motor.speed)
    assert sample.velocity == pytest.approx(true, abs=quantum)
    assert sample.velocity / quantum == pytest.approx(round(sample.velocity / quantum), abs=1e-6)
    assert sample.position == pytest.approx(ENTRY.gearbox.to_wheel(plant.motor.angle), abs=1e-3)


def test_narrow_counter_wraps_while_position_does_not():
    narrow = dataclasses.replace(ENTRY, encoder=dataclasses.replace(ENTRY.encoder, bits=8))
    plant = DrivenMotor(narrow, IDEAL)
    plant.command(0.0, 12.0)
    samples = [plant.sample(0.002 * k) for k in range(1, 1000)]
    assert max(s.encoder_count for s in samples) == 127
    assert samples[-1].position == pytest.approx(
        ENTRY.gearbox.to_wheel(plant.motor.angle), abs=1e-3
    )


def test_speed_under_load_matches_motor_equation():
    plant = DrivenMotor(ENTRY, IDEAL)
    plant.command(0.0, 10.0)
    plant.load(0.0, 65.5 * 0.01)
    plant.sample(20.0)
    p = ENTRY.parameters
    torque = 0.01 + p.coulomb_friction
    expected = (p.motor_constant * 10.0 - p.resistance * torque) / (
        p.resistance * p.viscous_friction + p.motor_constant**2
    )
    assert plant.motor.speed == pytest.approx(expected, rel=1e-9)
    assert not plant.load(20.0, math.nan)


def test_latched_command_takes_effect_at_the_next_sample():
    plant = DrivenMotor(ENTRY, DriveSettings(latch=True))
    plant.sample(0.01)
    plant.command(0.012, 5.0)
    plant.command(0.017, 6.0)  # the later one counts
    assert plant.sample(0.02).voltage == 0.0
    assert plant.sample(0.03).voltage == pytest.approx(6.0, rel=1e-12)  # rounding of a mean


@pytest.mark.parametrize(
    ("faults", "turns", "counts"),
    [
        ({}, 1, 1),
        ({"leads": -1}, -1, -1),
        ({"encoder": -1}, 1, -1),
        ({"leads": -1, "encoder": -1}, -1, 1),
    ],
)
def test_swapped_leads_reverse_motor_and_swapped_encoder_reverses_counts(faults, turns, counts):
    entry = dataclasses.replace(ENTRY, wiring=Wiring(**faults))
    plant = DrivenMotor(entry, IDEAL)
    plant.command(0.0, 6.0)
    plant.sample(0.1)
    sample = plant.sample(0.5)
    assert math.copysign(1, plant.motor.speed) == turns
    for value in (sample.encoder_count, sample.velocity, sample.position):
        assert math.copysign(1, value) == counts
    # The driver is unaware of both and reports the voltage and current that it applied.
    assert sample.voltage == pytest.approx(6.0, rel=1e-12) and sample.current > 0


def test_command_within_dead_zone_gives_zero_volts():
    plant = DrivenMotor(dataclasses.replace(ENTRY, wiring=Wiring(dead_zone=2.0)), IDEAL)
    plant.command(0.0, -2.0)
    assert plant.sample(0.5).voltage == 0.0
    plant.command(0.5, -2.01)
    assert plant.sample(1.0).voltage == pytest.approx(-2.01, rel=1e-12)
    assert plant.motor.speed < 0


def test_wiring_faults_are_read_from_motor_file_and_validated():
    motor = {"dc_gain": 25.0, "time_constant": 0.05, "leads": -1, "described_gear_ratio": 30.0}
    wiring = parse_motors({"left": motor}, "file")["left"].wiring
    assert wiring == Wiring(leads=-1, described_gear_ratio=30.0)
    for name, value in (("leads", 0), ("encoder", 2), ("dead_zone", -1.0)):
        with pytest.raises(ParameterError, match=name):
            parse_motors({"left": motor | {name: value}}, "file")


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
