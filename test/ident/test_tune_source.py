# SPDX-License-Identifier: Apache-2.0
"""The choice of the speed source, the observer in the loop, and speeds of a noisy angle."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wheel_simulation import Timing, simulate_closed_loop

from smp_motor_control.motor.file import load_motors
from smp_motor_control.motor.hardware import DriveSettings
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.wheel.loop import LoopSettings
from smp_motor_ident.cli import tuning
from smp_motor_ident.cli.tune import main, parser
from smp_motor_ident.cli.tuning import read_estimates
from smp_motor_ident.errors import BagError, DesignError
from smp_motor_ident.estimate import estimate as identify
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.report.document import identification_document, read_identification
from smp_motor_ident.result import ChainRecord
from smp_motor_ident.tune import Loop, design
from smp_motor_ident.tune.case import prepare
from smp_motor_ident.tune.feedback import Feedback, spectral_radius
from smp_motor_ident.tune.motors import Motors, make_motors
from smp_motor_ident.tune.plant import sample
from smp_motor_ident.tune.simulation import Controller, Inputs, draw_white_noise, simulate
from smp_motor_ident.tune.source import choose_source

MOTORS = Path(__file__).resolve().parents[2] / "config" / "motors_paper.yaml"


@pytest.fixture(scope="module")
def estimates():
    return read_estimates(MOTORS)


def make_observer_loop(rate: float, **more) -> Loop:
    return Loop(sample_time=1 / rate, speed_source="observer", **more)


def test_observer_with_the_true_model_reproduces_the_true_speed(estimates):
    motors = make_motors(estimates["front_left"])
    loop = make_observer_loop(200.0, delay=0.01)  # whole samples: the mean voltage is the voltage
    omega = np.geomspace(1.0, 600.0, 50)
    seen = sample(motors, loop).response(omega)
    true = sample(motors, loop).response(omega, true_speed=True)
    np.testing.assert_allclose(seen, true, rtol=1e-6)  # rounding of the matrix exponential


def test_response_with_a_wrong_observer_model_matches_the_simulated_loop(estimates):
    believed = make_motors(estimates["front_left"])
    actual = Motors(
        1.1 * believed.a0, 0.9 * believed.a1, believed.a2, believed.delay, believed.static_voltage
    )
    loop = make_observer_loop(500.0, delay=0.0013)
    plant = sample(actual, loop, believed=believed)
    feedback = design(estimates["front_left"], loop).feedback
    # At the ultimate gain of the response the simulated loop neither grows
    # nor decays, and the eigenvalues agree.
    omega = np.linspace(5.0, np.pi * 500.0, 200_000)
    L = (plant.response(omega) * feedback.response(omega, 1 / 500))[0]
    crossings = np.flatnonzero((L[:-1].imag > 0) != (L[1:].imag > 0))
    ultimate = 1 / max(-L[k].real for k in crossings)
    for factor, grows in ((0.97, False), (1.03, True)):
        trial = feedback.scaled(factor * ultimate)
        assert (spectral_radius(plant, trial)[0] > 1) == grows
        speed = simulate(plant, Controller(trial), Inputs(np.ones(1500))).speed[0]
        off = np.abs(speed - 1)
        assert (off[-300:].max() > off[600:900].max()) == grows


@pytest.mark.parametrize("rate", [200.0, 1000.0])
def test_gain_margin_holds_on_the_running_loop_with_its_observer(estimates, rate):
    T = 1 / rate
    one = design(estimates["rear_left"], make_observer_loop(rate))
    # Without friction and clamp the loop is linear except for the counts.
    entry = load_motors(MOTORS)["rear_left"]
    entry = replace(
        entry, parameters=replace(entry.parameters, coulomb_friction=0.0), supply_voltage=1e6
    )
    model = MotorModel(**{**one.motor, "static_voltage": 0.0})

    def late_ripple(factor: float) -> float:
        gains = replace(
            one.gains, p=factor * one.gains.p, i=factor * one.gains.i, d=factor * one.gains.d,
            u_clamp_min=-1e6, u_clamp_max=1e6, i_clamp_min=-1e6, i_clamp_max=1e6,
            feedforward_static=0.0, antiwindup_strategy="none",
        )  # fmt: skip
        run = simulate_closed_loop(
            entry,
            LoopSettings(gains=gains, speed_source="observer", model=model),
            # The observer learns the interval at rest, where the loop has nothing to do.
            lambda time: 2.0 if time > 0.2 else 0.0,
            400 * T + 1.0,
            timing=Timing(sample_time=T, delay=T),
            drive=DriveSettings(command_timeout=np.inf),
        )
        return float(np.abs(run.velocity[-100:] - 2.0).max())

    margin = one.margins.gain
    # A tenth inside it the loop has come to rest within the noise of its counts, a tenth beyond it
    # has not: what grows does not stop before the clamp, which is not reached here.
    assert late_ripple(1 + 0.9 * (margin - 1)) < 0.5
    assert late_ripple(1.1 * margin) > 10.0


def test_at_1_khz_the_observer_is_chosen_with_its_reason(estimates):
    loop, why = choose_source(estimates["rear_left"], Loop(sample_time=0.001))
    assert loop.speed_source == "observer"
    assert "the reported speed allows i = " in why
    plain = design(estimates["rear_left"], Loop(sample_time=0.001, noise_voltage=0.48))
    better = design(estimates["rear_left"], replace(loop, noise_voltage=0.48))
    assert better.gains.i > 1.5 * plain.gains.i
    assert better.performance.control_noise <= 1.01 * 0.48


@pytest.mark.parametrize(
    ("loop", "words"),
    [(Loop(sample_time=0.005), ""), (Loop(counts_per_revolution=None), "not known")],
    ids=["200 Hz", "without counts"],
)
def test_reported_speed_is_chosen_at_a_low_rate_or_without_counts(estimates, loop, words):
    chosen, why = choose_source(estimates["rear_left"], loop)
    assert chosen.speed_source == "measured" and words in why


def test_source_is_chosen_with_given_counts_after_identification_from_speed(estimates):
    loop, why = choose_source(
        estimates["rear_left"], Loop(sample_time=0.001, difference_window=0, speed_noise=0.5)
    )
    assert loop.counts_per_revolution
    assert "the reported speed allows" in why


def test_speed_source_is_printed_and_can_be_overridden(tmp_path, capsys):
    for source in ("auto", "measured"):
        output = tmp_path / f"{source}.yaml"
        options = ["--rate", "1000", "--speed-source", source, "--output", str(output)]
        assert main([str(MOTORS), *options]) == 0
        assert ("speed from the observer" in capsys.readouterr().out) == (source == "auto")
        chosen = "observer" if source == "auto" else "measured"
        assert f"speed_source: {chosen}" in output.read_text()


def test_design_refusal_repeats_only_the_advice_of_warnings(estimates):
    found = (
        Finding("not_separable", "note", "a family", advice="record the motor current too"),
        Finding("one_level", "warning", "one level", advice="record two levels of voltage"),
    )
    given = replace(estimates["rear_left"], combinations={}, parameters={}, findings=found)
    with pytest.raises(DesignError, match="two levels") as refused:
        design(given, Loop())
    assert "current too" not in str(refused.value)


def test_observer_of_a_coasting_driver_is_not_chosen_nor_its_settling_stated(estimates):
    """The observer predicts from the command, which differs from a coasting driver's voltage."""
    coast = ChainRecord(("coast",), {"fast_decay_ratio": 10.0, "viscous": 0.2})
    plain = replace(estimates["front_left"], findings=())
    coasting, loop = replace(plain, chain=coast, largest_voltage=12.0), make_observer_loop(500.0)
    assert np.isfinite(design(plain, loop).specification.settling.high)
    assert np.isnan(design(coasting, loop).specification.settling.high)
    chosen, why = choose_source(coasting, replace(loop, speed_source="measured"))
    assert chosen.speed_source == "difference" and "not the observer: some" in why
    assert np.isfinite(design(coasting, chosen).specification.settling.high)


T, GAIN, TAU, NOISE, SUPPLY = 5e-4, 20.0, 0.1, 3e-3, 12.0
DECAY = math.exp(-T / TAU)


@pytest.fixture(scope="module")
def record() -> Record:
    """Return a record of a motor driven by random steps, with only a noisy angle."""
    rng = np.random.default_rng(11)
    n = 8000
    voltage = np.repeat(rng.uniform(-10.0, 10.0, n // 100), 100)
    speed, angle = 0.0, np.zeros(n)
    for k in range(1, n):
        off = speed - GAIN * voltage[k]
        angle[k] = angle[k - 1] + GAIN * voltage[k] * T + TAU * (1 - DECAY) * off
        speed = GAIN * voltage[k] + DECAY * off
    shown = angle + NOISE * rng.standard_normal(n)
    hardware = Hardware(1.0, None, 0, SUPPLY)
    return Record("m", T * np.arange(n), voltage, None, None, shown, None, hardware=hardware)


@pytest.fixture(scope="module")
def found(record):
    return identify(record)


def loop_of(found, *options: str) -> Loop:
    return tuning.loop_for(found, parser().parse_args(["identification", *options]))


def hold_speed(one, noise: float, steps: int = 8000):
    """Return voltage and speed of a PI loop that holds half of the largest speed.

    The speed is the angle's difference over one sample, the voltage one sample late.
    """
    rng = np.random.default_rng(3)
    gains, target = one.gains, 0.5 * GAIN * SUPPLY
    speed = target
    angle, seen, late, integral = 0.0, noise * rng.standard_normal(), 0.5 * SUPPLY, 0.0
    volts, speeds = np.zeros(steps), np.zeros(steps)
    for k in range(steps):
        off = speed - GAIN * late
        angle += GAIN * late * T + TAU * (1 - DECAY) * off
        speed = GAIN * late + DECAY * off
        shown = angle + noise * rng.standard_normal()
        measured, seen = (shown - seen) / T, shown
        wanted = 0.5 * SUPPLY + gains.p * (target - measured) + integral
        late = min(max(wanted, -SUPPLY), SUPPLY)
        integral += gains.i * T * (target - measured)
        volts[k], speeds[k] = late, speed
    return volts[steps // 4 :], speeds[steps // 4 :]


def test_angle_noise_limits_the_gains(found):
    """Differenced over a sample, 3 mrad are 8.5 rad/s rms: gains that ignore it saturate."""
    # 8000 samples determine a standard deviation to 1 %: five times that.
    assert found.angle_noise == pytest.approx(NOISE, rel=0.05)
    assert found.speed_noise == 0.0
    loop = loop_of(found, "--speed-source", "measured")
    assert loop.angle_noise == found.angle_noise
    one = design(found, loop, structure="pi")
    deaf = design(found, replace(loop, angle_noise=0.0), structure="pi")
    volts, _ = hold_speed(deaf, NOISE)
    assert np.mean(np.abs(volts) == SUPPLY) > 0.3
    volts, speeds = hold_speed(one, NOISE)
    # 5 standard deviations of the rms of 6000 negatively correlated samples.
    assert volts.std() == pytest.approx(one.performance.control_noise, rel=0.05)
    assert volts.max() < SUPPLY and volts.min() > -SUPPLY
    assert speeds.mean() == pytest.approx(0.5 * GAIN * SUPPLY, rel=0.01)


def test_an_angle_with_negligible_noise_gives_the_same_gains(found):
    quiet = loop_of(found, "--angle-noise", "1e-9")
    assert quiet.angle_noise == 1e-9
    one, none = design(found, quiet), design(found, replace(quiet, angle_noise=0.0))
    assert one.gains.p == pytest.approx(none.gains.p, rel=1e-3)


@pytest.mark.parametrize(
    ("source", "window"), [("measured", 1), ("difference", 4), ("observer", 1)]
)
def test_simulated_control_noise_matches_the_density_of_the_angle_noise(found, source, window):
    """White angle noise causes the predicted control noise for every speed source."""
    loop = Loop(
        T, gear_ratio=1.0, counts_per_revolution=1e4, speed_source=source, difference_window=window,
        angle_noise=NOISE, supply_voltage=1e6,
    )  # fmt: skip
    problem = prepare(found, loop, "margin", {"samples": 50}).problem
    feedback = Feedback(0.05, 0.3)
    steps = 40_000
    inputs = Inputs(np.zeros(steps), angle_noise=draw_white_noise(NOISE, (1, steps)))
    run = simulate(problem.plant, Controller(feedback), inputs)
    # The observer's noise is slow: some 2000 of the samples are independent, 3 % is two deviations.
    assert run.voltage.std() == pytest.approx(problem.control_noise(feedback), rel=0.05)


def test_source_choice_suggests_a_longer_difference_window(found):
    loop, why = choose_source(found, loop_of(found))
    assert loop == loop_of(found)
    assert "difference over 1 samples of the loop" in why and "--difference-window 8" in why
    longer = loop_of(found, "--difference-window", "8")
    assert longer.averaging_given
    # Within the same control noise; without this limit the default may allow more.
    strict = (replace(one, noise_voltage=one.noise_limit) for one in (loop, longer))
    short, long = (design(found, one, samples=200) for one in strict)
    assert long.gains.i > 8 * short.gains.i
    assert "--difference-window" not in choose_source(found, longer)[1]


def test_angle_noise_is_stored_and_files_without_it_are_read(found, tmp_path):
    file = tmp_path / "identification.json"
    document = identification_document({"m": found})
    file.write_text(json.dumps(document))
    assert read_identification(file)["m"].angle_noise == found.angle_noise
    del document["motors"]["m"]["angle_noise"]
    file.write_text(json.dumps(document))
    assert read_identification(file)["m"].angle_noise == 0.0
    document["motors"]["m"]["angle_noise"] = -1.0
    file.write_text(json.dumps(document))
    with pytest.raises(BagError, match="angle_noise"):
        read_identification(file)


def test_counts_have_no_angle_noise_beyond_quantisation(record):
    per_turn = 2000.0
    count = np.floor(record.position * per_turn / (2 * math.pi)).astype(np.int64)
    hardware = replace(record.hardware, counts_per_revolution=per_turn)
    counted = identify(replace(record, position=None, count=count, hardware=hardware))
    assert counted.angle_noise == 0.0
