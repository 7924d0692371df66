# SPDX-License-Identifier: Apache-2.0
"""Identification results for the tests of reports and documents."""

import numpy as np

from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Hardware
from smp_motor_ident.report import tuning_page
from smp_motor_ident.report.figures import Comparison
from smp_motor_ident.result import (
    Candidate,
    Correlation,
    Estimate,
    FitPercent,
    Quantity,
    ResidualTests,
)
from smp_motor_ident.tune import Loop, design

PHYSICAL = {
    "resistance": (12.919, "ohm"),
    "inductance": (0.30994, "H"),
    "motor_constant": (0.011029, "N m/A"),
    "inertia": (1.13e-6, "kg m^2"),
    "viscous_friction": (2.4e-5, "N m s/rad"),
    "coulomb_friction": (1e-4, "N m"),
}
ALIKE = Finding("alike", "warning", "The delay & the inductance look alike at 100 Hz.",
                advice="Measure the current.")  # fmt: skip


def correlation(*values: float) -> Correlation:
    """Return a correlation with a band of 0.1."""
    return Correlation(np.arange(1.0, 1 + len(values)), np.array(values), 0.1)


def comparison(role: str, seconds: float = 20.0, begin: float = 0.0) -> Comparison:
    """Return a comparison under a square-wave voltage, with white noise on the speed."""
    rng = np.random.default_rng(7)
    time = np.arange(begin, begin + seconds, 0.005)
    voltage = 8 * np.sign(np.sin(2 * np.pi * 0.37 * time))
    speed = 25 * voltage
    return Comparison(role, "bag", time, voltage, speed + rng.normal(0, 2, time.size), speed)


def tuning_of_two(monkeypatch, one: Estimate) -> tuning_page.Tuning:
    """Return a tuning page's choice of two designs: half of the bandwidth, and all of it."""
    monkeypatch.setattr(tuning_page, "BANDWIDTH_SHARES", (0.5, 1.0))
    monkeypatch.setattr(tuning_page, "PHASE_MARGINS", (60.0,))
    monkeypatch.setattr(tuning_page, "BAND_DRAWS", 20)
    loop = Loop(sample_time=0.005, gear_ratio=65.5, counts_per_revolution=500, supply_voltage=12.0)
    return tuning_page.design_tuning(one, loop, design(one, loop))


def estimate(wheel: str = "front_left", *, current: bool = True) -> Estimate:
    """Return one motor's result, with measured current or from voltage and speed alone."""
    known = {n: Quantity(v, v / 100, (0.98 * v, 1.02 * v), u) for n, (v, u) in PHYSICAL.items()}
    hidden = {n: Quantity(None, unit=u, status="unidentifiable") for n, (_, u) in PHYSICAL.items()}
    combinations = {
        "dc_gain": Quantity(25.5, 0.1, (25.3, 25.7), "rad/s/V"),
        "time_constant": Quantity(0.04, 1e-4, (0.0398, 0.0402), "s"),
    }
    return Estimate(
        wheel=wheel,
        model="electromechanical" if current else "second_order",
        parameters=known if current else hidden,
        combinations=combinations,
        names=("dc_gain", "time_constant"),
        covariance=np.array([[1e-2, 5e-6], [5e-6, 1e-8]]),
        fit_percent=FitPercent(97.2, 96.8),
        candidates=(Candidate("first_order", 91.0, -10.0, False, "slower lag <b>missed</b>"),),
        residuals=ResidualTests(True, False, correlation(0.01, 0.02), correlation(0.3, 0.1)),
        findings=(ALIKE,),
        samples=1000,
        duration=10.0,
        sample_time=0.01,
        sources=("<script>alert('bag')</script>",),
        hardware=Hardware(65.5, 500.0, 16, 12.0, None),
    )
