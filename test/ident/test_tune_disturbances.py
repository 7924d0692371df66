# SPDX-License-Identifier: Apache-2.0
"""Gains and bands account for disturbances of the recording: loads, jitter, outliers, rounding."""

import math
from dataclasses import replace

import numpy as np
import pytest
from drives import LOOP, MOTOR, TRUE, change, estimate, overshoot
from motors import first_order

from smp_motor_control.wheel.loop import WheelLoop
from smp_motor_ident.cli import tuning
from smp_motor_ident.cli.tune import parser
from smp_motor_ident.estimate import estimate as identify
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.result import ChainRecord, ModelError, ResidualTests
from smp_motor_ident.tune import design
from smp_motor_ident.tune.case import prepare
from smp_motor_ident.tune.motors import compute_torque_noise
from smp_motor_ident.tune.verification import loop_settings
from smp_motor_ident.tune.writing import parameters


def test_reference_leaves_voltage_margin_for_an_identified_load():
    plain, uphill = (design(estimate(load_voltage=x), LOOP) for x in (0.0, -2.0))
    less = plain.reference.drive.top_speed - uphill.reference.drive.top_speed
    assert less == pytest.approx(2.0 * MOTOR["dc_gain"])
    assert uphill.reference.max_velocity < plain.reference.max_velocity


def test_bands_cover_a_load_held_by_friction_before_the_change():
    """Feed-forward compensates friction only; the load is left to the integral action."""
    uphill = {**TRUE, "load_voltage": 0.35}
    aware, ignorant = design(estimate(load_voltage=0.35), LOOP), design(estimate(), LOOP)
    time, speed = change(aware, uphill)
    settling = time[np.flatnonzero(np.abs(speed - 1) > 0.02)[-1] + 1]
    assert settling > ignorant.specification.settling.high + LOOP.sample_time
    assert settling <= aware.specification.settling.high
    downhill = overshoot(aware, {**TRUE, "load_voltage": -0.35})
    assert ignorant.specification.overshoot.high + 1.0 < downhill
    assert downhill <= aware.specification.overshoot.high + 0.25


def test_torque_noise_and_timing_jitter_widen_the_bands():
    rough = 0.02 * MOTOR["dc_gain"] / MOTOR["time_constant"]  # 0.02 V sqrt(s)
    load = Finding("torque_noise", "warning", "", {"acceleration": rough})
    assert compute_torque_noise(estimate(findings=[load]), 0.01) == pytest.approx(0.2)
    arrivals = Finding("arrival_beat", "note", "", {"latency": 3e-3})
    shaken, scattered, exact = (
        design(estimate(findings=f), LOOP, transition_time=0.05) for f in ([load], [arrivals], [])
    )
    assert math.isnan(shaken.specification.settling.high)
    assert math.isfinite(scattered.specification.settling.high)
    assert scattered.specification.settling.high >= exact.specification.settling.high
    assert scattered.reference.doubt == pytest.approx(3e-3)  # latency adds to the uncertainty


def test_overshoot_band_covers_an_identified_encoder_eccentricity():
    """The eccentricity is one count of 32 per turn."""
    count = 2 * math.pi / 32
    counts = replace(LOOP, counts_per_revolution=32.0)
    chain = ChainRecord(("encoder_error",), {"eccentricity": count, "eccentric_phase": 0.0})
    found = estimate(), replace(estimate(), chain=chain)
    true, shaken = (design(one, counts, transition_time=0.1).specification for one in found)
    assert shaken.overshoot.high > true.overshoot.high + 1.0


def test_overshoot_band_covers_identified_torque_noise():
    """Speed noise of standard deviation s adds several s of overshoot."""
    rough = 0.5 * MOTOR["dc_gain"] / MOTOR["time_constant"] * 0.1  # 0.5 V over 10 ms
    noise = Finding("torque_noise", "warning", "a load that fluctuates", {"acceleration": rough})
    steady, shaken = (design(estimate(findings=f), LOOP) for f in ([], [noise]))
    wander = 100 * rough * math.sqrt(0.5 * MOTOR["time_constant"]) / shaken.specification.change
    more = shaken.specification.overshoot.high - steady.specification.overshoot.high
    assert 1.0 * wander < more < 6.0 * wander  # the loop reduces it
    springs = ResidualTests(model_error=ModelError((30.0, 200.0), (0.0, 3.0), (0.1, 3.5)))
    assert compute_torque_noise(replace(estimate(findings=[noise]), residuals=springs), 0.01) == 0.0


def test_outliers_of_the_speed_are_rejected_by_the_loop():
    """2 % of the readings of a noisy speed are outliers of up to the top speed."""
    found = Finding("glitches", "warning", "", {"signal": "velocity", "samples": 20.0})
    counts = replace(LOOP, counts_per_revolution=None, speed_noise=1.0, difference_window=0)
    one = design(replace(estimate(findings=[found]), samples=1000), counts)
    alike = one.reference.transition_time
    quiet = design(replace(estimate(), samples=1000), counts, transition_time=alike)
    assert one.specification.overshoot.high > quiet.specification.overshoot.high
    written = parameters(one)
    assert written["implausible_jump"] == pytest.approx(8.0)
    loop = WheelLoop(loop_settings(written))
    rng, true, T = np.random.default_rng(5), 0.0, LOOP.sample_time
    lost, believed = [], []
    for k in range(6000):
        volts = 11.0 if k // 60 % 2 else -11.0  # reversals at nearly full voltage
        true += (MOTOR["dc_gain"] * volts - true) * -math.expm1(-T / MOTOR["time_constant"])
        outlier = rng.random() < 0.02
        reading = true + rng.normal() + outlier * rng.uniform(-250.0, 250.0)
        off = abs(reading - true)
        taken = not math.isnan(loop.speed(T, reading, 0, volts))
        if outlier and k % 60 > 20 and off > 40.0:  # at steady state
            believed.append(taken)
        elif not outlier:
            lost.append(not taken)
    assert np.mean(lost) < 0.005 and len(believed) > 20 and np.mean(believed) < 0.1


def test_fallback_difference_window_of_an_observer_stays_within_the_delay_margin():
    """Over one sample a count of 48 would be 65 rad/s, or 12 V with an observer's gains."""
    fast = replace(LOOP, sample_time=0.002, delay=0.002, speed_source="observer")
    for counts, longer in ((48.0, True), (1e5, False)):
        one = design(estimate(), replace(fast, counts_per_revolution=counts))
        window = parameters(one)["difference_window"]
        assert (window > 1) is longer
        assert window == 1 or window * 0.002 <= one.margins.delay
        volts = one.gains.p * 2 * math.pi / counts / (window * 0.002)
        assert volts < 0.25 * 12.0 and (volts * window > 0.5 * 12.0) is longer
    given = replace(fast, counts_per_revolution=48.0, averaging_given=True)
    assert parameters(design(estimate(), given))["difference_window"] == 1


def test_identified_speed_noise_limits_the_gains():
    """Measurement noise enters the voltage; a design that knows it limits the gains."""
    rng = np.random.default_rng(4)
    T, n, noise = 0.002, 6000, 6.0
    voltage = np.repeat(rng.uniform(-10.0, 10.0, n // 60), 60)
    speed = first_order(voltage, MOTOR["dc_gain"], MOTOR["time_constant"], T)
    shown = speed + noise * rng.standard_normal(n)
    record = Record("m", T * np.arange(n), voltage, None, shown, None, None)
    found = identify(replace(record, hardware=Hardware(1.0, None, 0, 12.0)))
    assert found.speed_noise == pytest.approx(noise, rel=0.05)
    usual = parser().parse_args(["identification"])
    loop = tuning.loop_for(found, usual)
    assert loop.speed_noise == found.speed_noise
    # The speed is instantaneous: an averaging window would have been identified.
    assert loop.difference_window == 0
    one, deaf = design(found, loop), design(found, replace(loop, speed_noise=0.0))
    heard = prepare(found, loop, "margin", {}).problem
    assert not heard.plant.window
    assert heard.control_noise(deaf.feedback) > 2 * loop.noise_limit
    assert one.performance.control_noise < 1.3 * loop.noise_limit
    assert one.specification.overshoot.high > deaf.specification.overshoot.high


def test_settling_is_not_stated_if_speed_quantisation_exceeds_its_band():
    """Within a quantum the loop sees no error; noise of that size would average out."""
    step = 0.1 * 0.5 * 240.0
    smooth = replace(
        LOOP, counts_per_revolution=None, difference_window=0, speed_noise=0.289 * step
    )
    steps = replace(smooth, speed_step=step)
    seen, rounded = (design(estimate(), x, max_velocity=240.0) for x in (smooth, steps))
    assert rounded.gains == seen.gains and math.isnan(rounded.specification.settling.high)
    assert rounded.specification.overshoot.high > 3.0  # half of a quantum, less the measured part
    assert replace(steps, speed_noise=0.4 * step).rounding == 0.0  # noise dithers the quantum
    fine = design(estimate(), replace(steps, speed_noise=0.03 * step, speed_step=0.1 * step))
    assert math.isfinite(fine.specification.settling.high)
    rng, T = np.random.default_rng(8), 0.01
    voltage = np.repeat(rng.uniform(-10.0, 10.0, 60), 30)
    speed = first_order(voltage, MOTOR["dc_gain"], MOTOR["time_constant"], T)
    shown = Record("m", T * np.arange(speed.size), voltage, velocity=step * np.round(speed / step))
    found = identify(replace(shown, hardware=Hardware(1.0, None, 0, 12.0)))
    assert tuning.loop_for(
        found, parser().parse_args(["identification"])
    ).rounding == pytest.approx(step)
