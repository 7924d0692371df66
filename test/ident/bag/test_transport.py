# SPDX-License-Identifier: Apache-2.0
"""Measurement of the loop delay from bags of loops with a known delay."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import Sent, header, merged, motion, serialized, write_mcap

from smp_motor_ident.bag.transport import measure_delay
from smp_motor_ident.cli.tune import main as tune
from smp_motor_ident.errors import BagError

MOTORS = Path(__file__).resolve().parents[3] / "config" / "motors_paper.yaml"
COMMAND = "smp_interfaces/msg/MotorCommand"
PERIOD = 5_000_000
"""[ns]"""
FINE = 10_000
"""Time grid of the applied voltage [ns]."""


def write_loop_bag(path: Path, arrival: np.ndarray, *, latch: bool, answering: bool = True) -> Path:
    """Write a bag of a loop whose command ``k`` arrives ``arrival[k]`` ns after sample ``k``."""
    rng = np.random.default_rng(7)
    one = motion(arrival.size, step=PERIOD)
    wanted = rng.uniform(-6, 6, arrival.size)
    begin = one.time[0]
    acts = np.arange(arrival.size) * PERIOD + arrival
    if latch:  # the driver's next sample takes the last command
        acts = np.ceil(acts / PERIOD).astype(np.int64) * PERIOD
    volts = np.zeros(arrival.size * PERIOD // FINE)
    for k in np.argsort(acts, kind="stable"):
        volts[acts[k] // FINE :] = wanted[k]
    applied = np.roll(volts.reshape(arrival.size, -1).mean(axis=1), 1)
    sent = merged(replace(one, voltage=applied), latency=150_000)
    for k, late in enumerate(arrival):
        stamp = one.time[k] if answering else one.time[k] + 1_234_567
        data = serialized(COMMAND, header=header(stamp), voltage=float(wanted[k]))
        sent.append(
            Sent("/front_left/motor_command", COMMAND, int(begin + k * PERIOD + late), data)
        )
    return write_mcap(path, sorted(sent, key=lambda s: s.stamp))


def arrivals(n: int = 600) -> np.ndarray:
    """Return delays of 1.2 ms plus an exponential tail of 0.3 ms, on the fine grid."""
    late = 1.2e6 + np.random.default_rng(3).exponential(0.3e6, n)
    return (late / FINE).astype(np.int64) * FINE


def test_delay_of_driver_that_applies_commands_on_arrival_is_measured(tmp_path):
    arrival = arrivals()
    found = measure_delay(write_loop_bag(tmp_path / "a.mcap", arrival, latch=False))["front_left"]
    assert not found.latched
    assert found.answers == 600
    # One delay for all, within the spread of the tail and one trial step (0.25 ms).
    assert found.usual == pytest.approx(1e-9 * np.median(arrival), abs=0.3e-3)
    assert found.longest == pytest.approx(1e-9 * np.quantile(arrival, 0.95), abs=1e-6)
    assert found.until_applied(0.002) == (found.usual, found.longest)


def test_driver_that_latches_commands_at_its_next_sample_is_recognised(tmp_path):
    found = measure_delay(write_loop_bag(tmp_path / "a.mcap", arrivals(), latch=True))["front_left"]
    assert found.latched
    assert found.until_applied(0.005) == (0.005, 0.005)
    # At a faster rate the tail misses the next sample, and the delay is two samples.
    assert found.until_applied(0.0018) == (0.0018, 0.0036)


def test_few_late_commands_do_not_affect_the_delay(tmp_path):
    arrival = arrivals()
    arrival[200:220] += 200_000_000  # a stall of the machine
    found = measure_delay(write_loop_bag(tmp_path / "a.mcap", arrival, latch=False))["front_left"]
    assert found.longest < 0.005


def test_bag_whose_commands_answer_no_state_is_refused(tmp_path):
    bag = write_loop_bag(tmp_path / "a.mcap", arrivals(), latch=False, answering=False)
    with pytest.raises(BagError, match="no wheel with 50 motor_command that answer"):
        measure_delay(bag)


def test_tune_designs_for_the_delay_of_a_bag_and_reports_it(tmp_path, capsys):
    bag = write_loop_bag(tmp_path / "a.mcap", arrivals() + 6_000_000, latch=False)
    output = tmp_path / "gains.yaml"
    assert tune([str(MOTORS), "--bag", str(bag), "--output", str(output)]) == 0
    loops = json.loads((tmp_path / "gains.json").read_text())["wheels"]
    found = measure_delay(bag)["front_left"]
    assert loops["front_left"]["loop"]["delay"] == pytest.approx(found.longest)
    assert loops["front_left"]["loop"]["usual_delay"] == pytest.approx(found.usual)
    # The bag holds one wheel; the others have the default delay.
    assert loops["rear_left"]["loop"]["delay"] == 0.005
    for text in (capsys.readouterr().out, output.read_text()):
        assert "600 commands of" in text
        assert "rear_left" in text and "has no delay data; one sample is assumed" in text
