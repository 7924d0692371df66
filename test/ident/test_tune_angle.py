# SPDX-License-Identifier: Apache-2.0
"""Gains for a speed differenced from a noisy angle, with and without counts."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from smp_motor_ident.cli import tuning
from smp_motor_ident.cli.tune import parser
from smp_motor_ident.errors import BagError
from smp_motor_ident.estimate import estimate as identify
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.report.document import identification_document, read_identification
from smp_motor_ident.tune import Loop, design
from smp_motor_ident.tune.case import prepare
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.simulation import Controller, Inputs, draw_white_noise, simulate
from smp_motor_ident.tune.source import choose_source

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
