# SPDX-License-Identifier: Apache-2.0
"""Findings have codes, and every threshold is in one table."""

import re
from dataclasses import replace
from pathlib import Path

import motors
import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from smp_motor_ident import limits
from smp_motor_ident.estimate import estimate
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Record

ROOT = Path(__file__).resolve().parents[2]
ROW = re.compile(r"\| `(\w+)` \| (\S+) \| (.+?) \| (.+?) \| `(.+)` \|")


def test_every_limit_has_a_unit_a_reason_and_a_test_that_exists():
    files = {path.name: path.read_text() for path in (ROOT / "test").rglob("test_*.py")}
    table = (ROOT / "smp_motor_ident" / "limits.md").read_text()
    rows = [line for line in table.splitlines() if line.startswith("| `")]
    assert len(rows) > 100
    for row in rows:
        limit = ROW.fullmatch(row)
        assert limit is not None, row
        assert getattr(limits, limit[1]) == float(limit[2])
        for named in limit[5].split("; "):
            name, _, words = named.partition(": ")
            # "test_a.py: what holds" is test_a.py with a test_what_holds...
            assert f"def test_{words.replace(' ', '_')}" in files[name], named


def test_clean_data_have_no_finding_beyond_a_note():
    result = estimate(motors.record("rear_left", seconds=8.0))
    assert [f for f in result.findings if f.severity != "note"] == []


def test_autocorrelation_curve_agrees_with_the_whiteness_verdict():
    result = estimate(motors.record("rear_left", seconds=8.0))
    curve = result.residuals.autocorrelation
    inside = bool(np.all(np.abs(curve.value[1:]) < curve.band))
    assert result.residuals.white == inside
    assert curve.value[0] == pytest.approx(1.0, abs=1e-12)  # by definition, up to rounding


def test_findings_of_the_reader_are_kept():
    read = Finding("samples_missing", "warning", "what the reader found")
    result = estimate(replace(motors.record("rear_left"), findings=(read,)))
    assert read.message in result.warnings
    assert read in result.findings


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_time_constant_uncertainty_covers_a_lag_of_the_speed_sensor(share):
    """A motor lag and a filter lag of ``share`` of it, under random voltage, solved exactly."""
    rate, lag, rng = 500.0, 0.05, np.random.default_rng(5)
    voltage = np.repeat(rng.choice([-8.0, -4.0, 4.0, 8.0], 60), 40)
    motor = np.polymul([lag, 1.0], [0.02 * lag, 1.0])  # with a winding
    lags = np.polymul(motor, [share * lag, 1.0]) if share else motor
    num, den, _ = cont2discrete(([20.0], lags), 1 / rate)
    speed = lfilter(num.ravel(), den, voltage)
    noisy = speed + 0.3 * rng.standard_normal(speed.size)
    found = estimate(Record("motor", np.arange(speed.size) / rate, np.r_[0.0, voltage[:-1]],
                            velocity=noisy))  # fmt: skip
    motor, filtered = found.combinations["time_constant"], found.value("sensor_lag")
    assert abs(motor.value + filtered - (1.02 + share) * lag) < 0.003
    if not filtered:  # the whole second lag may be the filter's
        assert abs(motor.value - 1.02 * lag) < 2.5 * motor.total_std


def test_underdamped_motor_is_not_reported_as_filtered_speed():
    # Motor 1 of Table 1: L/R of 24 ms, R J / (K^2 + R b) of 34 ms, damping 0.90.
    found = estimate(replace(motors.record("front_left", seconds=8.0), current=None)).findings
    assert not [f for f in found if f.code == "low_passed_speed"]


@pytest.mark.parametrize(("scale", "severity"), [(1.0, "note"), (1.3, "unreliable")])
def test_current_scale_error_is_found_from_a_measured_resistance(scale, severity):
    made = motors.record("rear_left", seconds=3.0)
    ohm = motors.truth("rear_left", 0.3)["resistance"]
    measured = replace(
        made, current=scale * made.current, hardware=replace(made.hardware, resistance=ohm)
    )
    found = estimate(measured)
    about = next(f for f in found.findings if f.code == "current_scale")
    assert about.severity == severity
    assert ("measure the resistance warm" in about.advice) is (severity == "unreliable")
    # The interval of R determines the scale to far better than a hundredth.
    assert abs(about.evidence["scale"] - scale) < 0.01
    assert "resistance" in about.evidence["of_the_scale"]
    assert "motor_constant" not in about.evidence["of_the_scale"]


@pytest.mark.parametrize(("kind", "severity"), [("square", "warning"), ("fourier", "note")])
def test_supply_current_is_confounded_with_scale_under_one_voltage_amplitude(kind, severity):
    found = estimate(motors.record("rear_left", kinds=(kind,), seconds=3.0))
    about = next(f for f in found.findings if f.code == "current_scale")
    assert about.severity == severity
    assert ("supply" in about.message) is (severity == "warning")


def test_noisy_current_is_not_reported_as_poor_fit():
    good = motors.record("rear_left", seconds=3.0)
    noise = 3.0 * np.std(good.current) * np.random.default_rng(0).standard_normal(len(good))
    found = estimate(replace(good, current=good.current + noise))
    assert "poor_fit_of_current" not in [f.code for f in found.findings]
