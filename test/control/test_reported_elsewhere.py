# SPDX-License-Identifier: Apache-2.0
"""Faults that users of other wheel drivers reported, with their sources, and oscillations."""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from wheel_world import DT, SETTINGS, SUPPLY, World

from smp_motor_control.encoder import CounterWidth, Encoder
from smp_motor_control.fields import build_settings, parameters_in
from smp_motor_control.motor.file import MotorEntry, load_motors
from smp_motor_control.motor.hardware import DrivenMotor, DriveSettings, Sample
from smp_motor_control.motor.parameters import Gearbox, MotorParameters
from smp_motor_control.parameter_file import flatten, read_parameters
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.controller import State, WheelController, WheelSettings
from smp_motor_control.wheel.faults import Fault
from smp_motor_control.wheel.loop import LoopSettings
from smp_motor_control.wheel.oscillation import Oscillation

GAIN, RATIO = 47.6, 30.0
GAINS = PidGains(
    p=2.0, i=10.0, u_clamp_min=-12.0, u_clamp_max=12.0, antiwindup_strategy="back_calculation"
)
FED_FORWARD = PidGains(
    p=2.0, i=10.0, u_clamp_min=-12.0, u_clamp_max=12.0, feedforward_velocity=RATIO / GAIN,
    feedforward_static=0.6,
)  # fmt: skip


def drive_controller(wheel, plant, rate, seconds, target, see=lambda sample, t: sample):
    """Drive a motor by its controller; yield the time after each sample [s].

    ``see`` changes the samples on their way to the controller.
    """
    wheel.activate(100.0)
    for k in range(1, round(seconds * rate)):
        now = 100.0 + k / rate
        sample = see(plant.sample(now), k / rate)
        wheel.take_setpoint(target(k / rate), now)
        stamp = round(1e9 * now)
        answer = wheel.take_feedback(SimpleNamespace(**sample._asdict()), stamp, stamp, now)
        wheel.tick(now)
        if answer is not None:
            plant.command(now, answer)
        yield k / rate


@dataclass
class Wheel:
    """A hobby gear motor under a controller: 48 counts per revolution, 30:1, 12 V."""

    settings: LoopSettings = field(default_factory=lambda: LoopSettings(gains=GAINS))
    counts: float = 48.0
    bits: int = 0
    described_bits: int | None = None
    rate: float = 100.0
    static: float = 0.6
    see: Callable[[Sample, float], Sample] = lambda sample, t: sample

    def drive(self, target: float, seconds: float) -> WheelController:
        """Drive at a set-point; store the true mean speed of the second half [rad/s]."""
        motor = MotorParameters.from_combinations(
            dc_gain=GAIN, time_constant=0.05, static_voltage=self.static
        )
        entry = MotorEntry(motor, Gearbox(RATIO), Encoder(self.counts, self.bits), 12.0)
        bits = self.bits if self.described_bits is None else self.described_bits
        wheel = WheelController(WheelSettings(loop=self.settings))
        wheel.set_hardware(entry.gearbox, Encoder(self.counts, bits), 12.0)
        plant = DrivenMotor(entry, DriveSettings(pwm_steps=255, latch=True), start=100.0)
        run = drive_controller(wheel, plant, self.rate, seconds, lambda t: target, self.see)
        speeds = [plant.motor.speed / RATIO for _ in run]
        tail = speeds[len(speeds) // 2 :]
        self.mean, self.fastest = sum(tail) / len(tail), max(map(abs, tail))
        return wheel


def scaling_speed(share: float, since: float = 3.0) -> Callable[[Sample, float], Sample]:
    """Return a sensor that scales the speed from a given time on."""
    return lambda s, t: s if t < since else s._replace(velocity=share * s.velocity)


@pytest.mark.parametrize("share", [0.2, 0.3])
@pytest.mark.parametrize(("gains", "since"), [(GAINS, 3.0), (FED_FORWARD, 0.0)])
def test_encoder_losing_counts_is_reported_as_overload(gains, since, share):
    """linorobot/linorobot2 issue 154: "one of my encoder broken, so pid try to correct it"."""
    wheel = Wheel(LoopSettings(gains=gains), see=scaling_speed(share, since)).drive(5.0, 10.0)
    assert wheel.state is State.DRIVING and wheel.overload is not None
    voltage, needed = wheel.overload
    assert voltage > 11.0 and needed < 4.0


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_dead_or_nearly_dead_encoder_stops_the_wheel(share):
    """sonyccd/roboclaw_ros issue 4: no encoder, full PWM."""
    wheel = Wheel(see=scaling_speed(share, 0.0)).drive(5.0, 5.0)
    assert wheel.recovery.fault in (Fault.NO_MOTION, Fault.NOT_FOLLOWING)


@pytest.mark.parametrize("target", [0.1, 1.0, 5.0, 15.0, 25.0])
@pytest.mark.parametrize("gains", [GAINS, FED_FORWARD])
def test_intact_wheel_reports_no_overload(gains, target):
    wheel = Wheel(LoopSettings(gains=gains)).drive(target, 8.0)
    assert wheel.overload is None and wheel.recovery.failures == 0


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(
    ("source", "window"), [("measured", 4), ("difference", 4), ("difference", 1)]
)
def test_undeclared_counter_wrap_is_detected_and_unwrapped(source, window, bits):
    """AIRclub-UdeSA/physical_rosmaster pull request 1: counters subtracted as they are."""
    gains = LoopSettings(gains=GAINS, speed_source=source, difference_window=window)
    one = Wheel(gains, counts=48.0 if bits == 8 else 4000.0, bits=bits, described_bits=0)
    wheel = one.drive(3.0, 10.0)
    assert one.mean == pytest.approx(3.0, rel=0.02) and one.fastest < 3.5
    assert wheel.recovery.failures == 0 and wheel.loop.wraps_at == bits


@pytest.mark.parametrize("window", [1, 4])
def test_counter_wrapping_at_9000_does_not_disturb_the_wheel(window):
    """hoverboard-firmware-hack-FOC pull request 1: odometry in the range from 0 to 9000."""
    loop = replace(SETTINGS.loop, speed_source="difference", difference_window=window)
    world = World(replace(SETTINGS, loop=loop))
    world.wheel.set_hardware(Gearbox(1.0), Encoder(9000.0), SUPPLY)
    world.sensor = lambda sample: replace(
        sample, encoder_count=math.floor(world.angle * 9000.0 / (2 * math.pi)) % 9000
    )
    world.run(30.0)
    assert [abs(speed - 1.5) < 0.05 for _, _, speed in world.log[200:]].count(False) == 0
    assert world.wheel.refused == {"feedback count that jumps": 7}, "once a turn"


def test_counter_width_is_not_inferred_from_steps_that_are_no_wraps():
    width = CounterWidth()
    counts = [0, 100, 205, 300, 100, -156, -420, -700, 40_000, 40_010, 40_021, -25_530]
    assert [width.step(count) for count in counts[:-1]] == [0] * 11
    assert width.step(counts[-1]) == 0, "65551 back after 11 forward leaves -15"
    assert [CounterWidth().step(k) for k in (5, 2**40)] == [0, 0]


@pytest.mark.parametrize("target", [0.005, 0.02, 0.1, 0.2])
@pytest.mark.parametrize(("counts", "rate"), [(48.0, 100.0), (12.0, 50.0), (8.0, 20.0)])
def test_wheel_does_not_run_away_at_set_points_near_zero(counts, rate, target):
    """RoverRobotics-archive/roverrobotics_ros2 issue 4: near zero it drives off at top speed."""
    one = Wheel(counts=counts, rate=rate)
    wheel = one.drive(target, 20.0)
    assert one.mean == pytest.approx(target, abs=0.03) and one.fastest < 1.0
    assert wheel.recovery.failures == 0


@pytest.mark.parametrize("window", [1, 10])
def test_mean_speed_is_tracked_with_single_pulses_per_sample(window):
    """waveshareteam/ugv_base_ros pull request 11: 0 or 1 pulse a tick, it cogs and stalls."""
    slow = LoopSettings(gains=GAINS, speed_source="difference", difference_window=window)
    one = Wheel(slow, counts=44.0, rate=200.0)
    wheel = one.drive(0.25, 20.0)
    assert one.mean == pytest.approx(0.25, rel=0.1) and wheel.recovery.failures == 0


def test_gains_for_10_hz_track_with_different_static_friction():
    """ros-mobile-robots/diffbot issue 13: F 0.8, P 0.35, I 0.5, D 0.01, clamped, at 10 Hz."""
    gains = PidGains(p=0.35, i=0.5, d=0.01, feedforward_velocity=0.8, i_clamp_min=-3.5,
                     i_clamp_max=3.5, u_clamp_min=-6.0, u_clamp_max=6.0)  # fmt: skip
    for static in (0.2, 1.0, 2.0):
        one = Wheel(LoopSettings(gains=gains), rate=10.0, static=static)
        wheel = one.drive(3.0, 20.0)
        assert one.mean == pytest.approx(3.0, rel=0.02) and wheel.recovery.failures == 0


CONFIG = Path(__file__).resolve().parents[2] / "config"


def load_settings(file: str, wheel: str = "front_left") -> WheelSettings:
    """Return the settings of a parameter file, as wheel_pid makes them."""
    known = parameters_in(WheelSettings)
    values = {name: entry.default for name, entry in known.items()}
    format_parameters = flatten(read_parameters(CONFIG / file)[f"/**/{wheel}/wheel_pid"])
    return build_settings(WheelSettings, {**values, **format_parameters})


def proportional_only(p: float) -> WheelSettings:
    clamped = PidGains(p=p, u_clamp_min=-12.0, u_clamp_max=12.0)
    return replace(SETTINGS, loop=LoopSettings(gains=clamped))


def drive(
    settings, rate, target=lambda t: 1.5, noise=0.0, seconds=8.0, seed=0, motor="front_left",
    latch=True,
):  # fmt: skip
    """Drive a motor of the paper; return the time of detection [s] and the controller."""
    entry, draw = load_motors(CONFIG / "motors_paper.yaml")[motor], random.Random(seed)
    wheel = WheelController(settings)
    wheel.set_hardware(entry.gearbox, entry.encoder, entry.supply_voltage)
    plant = DrivenMotor(entry, DriveSettings(pwm_steps=1000, latch=latch), start=100.0)

    def see(sample: Sample, _: float) -> Sample:
        return sample._replace(velocity=sample.velocity + draw.gauss(0.0, noise))

    run = drive_controller(wheel, plant, rate, seconds, target, see)
    return min((t for t in run if wheel.oscillation.found is not None), default=math.inf), wheel


def test_oscillation_of_paper_gains_at_50_hz_is_found_without_model():
    settings = load_settings("gains_paper.yaml")
    assert settings.loop.model is None and settings.loop.drive is None
    found, wheel = drive(settings, 50.0)
    oscillation = wheel.oscillation.found
    assert found < 2.0 and wheel.state is State.DRIVING
    # The true speed oscillates by 4 rad/s peak to peak, with eight samples per period.
    assert oscillation.amplitude == pytest.approx(2.0, abs=0.4)
    assert oscillation.frequency == pytest.approx(6.1, abs=0.4)


@pytest.mark.parametrize(
    ("rate", "p"), [(20.0, 50.0), (50.0, 10.0), (100.0, 10.0), (200.0, 20.0), (200.0, 300.0)]
)
def test_oscillation_of_unstable_gains_is_found_at_any_rate(rate, p):
    found, wheel = drive(proportional_only(p), rate)
    assert found < 5.0 and wheel.state is State.DRIVING


@pytest.mark.parametrize(("rate", "p"), [(15.0, 15.0), (33.0, 6.0), (33.0, 60.0)])
def test_oscillation_with_few_samples_per_period_is_found(rate, p):
    """Three to five samples per period, in a slow loop on the most powerful motor."""
    found, wheel = drive(proportional_only(p), rate, lambda t: -2.0, motor="rear_left", latch=False)
    assert found < 5.0 and wheel.state is State.DRIVING


@pytest.mark.parametrize("rate", [100.0, 200.0, 500.0])
@pytest.mark.parametrize("speed", [0.0, 0.02, 0.1, 0.5, 2.4])
def test_stable_loop_is_not_reported_at_any_speed(rate, speed):
    found, _ = drive(load_settings("gains.yaml"), rate, lambda t: speed, seconds=6.0)
    assert found == math.inf


@pytest.mark.parametrize(
    "target",
    [
        lambda t: 1.5 * math.sin(2 * math.pi * t),
        lambda t: 1.5 if t % 0.6 < 0.3 else -1.5,
        lambda t: 2.0 * round(math.sin(9.0 * t)),
    ],
)
def test_oscillating_set_point_is_not_reported_as_oscillation(target):
    found, _ = drive(load_settings("gains.yaml"), 200.0, target)
    assert found == math.inf


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rate", [100.0, 200.0, 500.0])
def test_measurement_noise_is_not_reported_as_oscillation(rate, seed):
    found, _ = drive(load_settings("gains.yaml"), rate, lambda t: 1.0, 0.3, seed=seed)
    assert found == math.inf


@pytest.mark.parametrize("rate", [10.0, 33.0, 100.0])
def test_white_noise_is_not_reported_as_oscillation_at_any_rate(rate):
    oscillation, draw = Oscillation(), random.Random(7)
    for _ in range(round(600 * rate)):
        oscillation.add(1.0 / rate, 1.0, 1.0 + draw.gauss(0.0, 1.0))
        assert oscillation.found is None


def test_oscillation_report_ends_with_the_oscillation():
    oscillation = Oscillation()
    for k in range(400):
        oscillation.add(0.01, 1.0, 1.0 + 0.8 * math.sin(40.0 * 0.01 * k))
    assert oscillation.found.amplitude == pytest.approx(0.8, abs=0.02)
    assert oscillation.found.frequency == pytest.approx(40.0 / (2 * math.pi), rel=0.02)
    for _ in range(400):
        oscillation.add(0.01, 1.0, 1.0)
    assert oscillation.found is None


def test_count_quantisation_is_not_reported_as_oscillation():
    """One count of 16 per revolution in 10 ms is 39 rad/s."""
    oscillation = Oscillation()
    oscillation.set_count(2 * math.pi / 16)
    for k in range(4000):
        oscillation.add(0.01, 5.0, 39.27 * (math.floor(0.1273 * (k + 1)) - math.floor(0.1273 * k)))
    assert oscillation.found is None


@pytest.mark.parametrize("reading", [-999.0, 999.0, -60.0, -12.0, 8.0, -3.0, 0.0])
@pytest.mark.parametrize("apart", [0.5, 0.2])
def test_isolated_false_readings_do_not_stop_the_wheel(reading, apart):
    """Without drive.*, the motor's top speed and time constant are unknown."""
    world = World().run(2.0)
    every = round(apart / DT)

    def sensor(sample):
        spoilt = round(world.now / DT) % every == 0
        return replace(sample, velocity=reading) if spoilt else sample

    world.sensor = sensor
    worst = 0.0
    for _ in range(1000):
        world.step()
        assert world.wheel.recovery.fault is None
        worst = max(worst, abs(world.speed - 1.5))
    assert world.wheel.recovery.failures == 0 and world.wheel.state is not State.FAULT
    # Gross outliers never reach the loop; at 10 ms a reading of 8 may be an impact.
    assert worst < (0.1 if abs(reading) > 20.0 else 1.0)
