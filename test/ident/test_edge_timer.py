# SPDX-License-Identifier: Apache-2.0
"""Speed from the time between encoder edges is a mean, held until the next edge."""

from dataclasses import replace

import numpy as np
import pytest
from motors import check

from smp_motor_ident.estimate import estimate
from smp_motor_ident.quality.edge_timer import interpolate_edge_timing, read_held_share
from smp_motor_ident.record import Hardware, Record

GAIN, LAG, STATIC, STEP, FINE = 40.0, 0.06, 0.4, 0.005, 1e-4
COUNT = 2 * np.pi / 48


def steps(seconds: float = 15.0) -> np.ndarray:
    """Return a voltage of random levels, by rows."""
    rows = int(seconds / STEP)
    levels = np.random.default_rng(5).uniform(-4.0, 4.0, rows // 40 + 1)
    return np.repeat(levels, 40)[:rows]


def simulate_motion(volts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return speed and angle of a motor with friction on a fine grid."""
    rows = volts.size
    speed, w = np.zeros(rows * round(STEP / FINE)), 0.0
    for k in range(speed.size):
        u = volts[k // round(STEP / FINE)]
        if w == 0.0 and abs(u) <= STATIC:
            continue
        way = np.sign(w) if w else np.sign(u)
        after = w + FINE / LAG * (GAIN * (u - STATIC * way) - w)
        w = 0.0 if after * way < 0.0 else after
        speed[k] = w
    return speed, np.cumsum(speed) * FINE


def read_edge_timer(
    speed: np.ndarray, angle: np.ndarray, tick: float, count: float = COUNT
) -> np.ndarray:
    """Return an edge timer's reading at each row; zero after a tenth of a second without edge."""
    edges = np.floor(angle / count + 0.3)
    at = np.flatnonzero(np.diff(edges)) + 1
    share = np.maximum(edges[at], edges[at - 1]) - 0.3 - angle[at - 1] / count
    instants = (at + share / ((angle[at] - angle[at - 1]) / count)) * FINE
    ticks = np.maximum(np.diff(np.floor(instants / tick)), 1.0) * tick
    reading = np.append(0.0, np.sign(edges[at] - edges[at - 1])[1:] * count / ticks)
    rows = np.arange(1, speed.size * FINE / STEP + 0.5) * STEP
    last = np.searchsorted(instants, rows, side="right") - 1
    said = np.where(last < 0, 0.0, reading[last])
    return np.where(rows - instants[last] > 0.1, 0.0, said)


def simulate_record(tick: float, per_turn: float | None) -> Record:
    volts = steps()
    speed, angle = simulate_motion(volts)
    hardware = Hardware(counts_per_revolution=per_turn)
    shown = read_edge_timer(speed, angle, tick)
    time = STEP * np.arange(volts.size)
    return Record("motor", time, volts, velocity=shown, hardware=hardware)


@pytest.mark.parametrize("tick, per_turn", [(1e-6, None), (4e-6, 48.0)])
def test_held_edge_timer_readings_are_not_estimated_as_dead_zone(tick, per_turn):
    record = simulate_record(tick, per_turn)
    (said,) = [f for f in interpolate_edge_timing(record).findings if f.code == "edge_timer"]
    assert said.evidence["count"] == pytest.approx(COUNT, rel=0.25)  # from holding times, to a row
    found = estimate(record)
    assert "dead_zone" not in found.combinations and not found.unreliable
    check(found, {"dc_gain": GAIN, "static_voltage": STATIC}, most=0.25)


def test_rounded_or_held_speed_is_not_detected_as_edge_timed():
    volts = steps()
    speed, angle = simulate_motion(volts)
    every = round(STEP / FINE)
    counts = np.floor(angle[every - 1 :: every] / COUNT)
    time = STEP * np.arange(volts.size)
    true = speed[every - 1 :: every]
    for shown in (
        np.diff(counts, prepend=0.0) * COUNT / STEP,
        true,
        np.round(true, 1),
        np.round(true),
        np.repeat(true[::7], 7)[: true.size],
        true + np.random.default_rng(1).normal(0.0, 1.0, true.size),
    ):
        for per_turn in (None, 48.0):
            hardware = Hardware(counts_per_revolution=per_turn)
            record = Record("motor", time, volts, velocity=shown, hardware=hardware)
            assert interpolate_edge_timing(record) is record and read_held_share(record) == 0.0
    counted = replace(record, count=counts.astype(np.int64))
    assert interpolate_edge_timing(counted) is counted


def test_exponential_decay_of_a_filter_is_not_detected_as_edge_timed():
    """A decay logged with four digits passes all magnitudes and repeats some values."""
    shown = 300.0 * np.exp(-np.arange(2000) / 90.0)
    tail = np.array([float(f"{w:.4g}") for w in shown])
    tail[tail < 2e-6] = np.repeat(tail[tail < 2e-6][::3], 3)[: (tail < 2e-6).sum()]
    record = Record("motor", STEP * np.arange(tail.size), np.zeros(tail.size), velocity=tail)
    assert interpolate_edge_timing(record) is record


@pytest.mark.parametrize("per_turn", [60, 150, 400])
def test_friction_is_estimated_from_edge_timer_speed_under_fast_reversals(per_turn):
    """Near zero speed a reading is up to two rows late; elsewhere nearly not at all."""
    volts = np.repeat(np.tile([3.0, -3.0], 25), 60)
    speed, angle = simulate_motion(volts)
    shown = read_edge_timer(speed, angle, 1e-6, 2 * np.pi / per_turn)
    hardware = Hardware(counts_per_revolution=float(per_turn))
    record = Record("motor", STEP * np.arange(volts.size), volts, velocity=shown, hardware=hardware)
    true = speed[round(STEP / FINE) - 1 :: round(STEP / FINE)]
    late, off = shown - true, interpolate_edge_timing(record).velocity - true
    assert np.nanmean(off**2) < 0.1 * np.mean(late**2)  # a third of the size
    check(estimate(record), {"dc_gain": GAIN, "static_voltage": STATIC})
