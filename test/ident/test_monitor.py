# SPDX-License-Identifier: Apache-2.0
"""The monitor of a commissioned motor, on signals of an independent simulator."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import expm

from smp_motor_ident.errors import BagError, ParameterError
from smp_motor_ident.live.monitor import CommissionedValues, Monitor, read_commissioned_values
from smp_motor_ident.report import history
from smp_motor_ident.result import Estimate

MOTOR = CommissionedValues(12.919, 0.30994, 0.011029, 1.13e-6, 2.4e-5, 3.8417e-4, 12.0)
COUNT = 2 * math.pi / 500
STEP = 0.01


@dataclass
class Motor:
    """A motor simulated exactly over steps; its parameters change between steps."""

    resistance: float = MOTOR.resistance
    constant: float = MOTOR.motor_constant
    friction: float = 1.0

    def __post_init__(self) -> None:
        self.state = [0.0, 0.0, 0.0]
        self.change()

    def change(self) -> None:
        """Recompute the transition matrix."""
        r, k, c = self.resistance, self.constant, MOTOR
        b = self.friction * c.viscous_friction
        a = np.zeros((5, 5))
        a[0] = [-r / c.inductance, -k / c.inductance, 0, 1 / c.inductance, 0]
        a[1] = [k / c.inertia, -b / c.inertia, 0, 0, 1 / c.inertia]
        a[2, 1] = 1.0
        self.rows = expm(a * STEP)[:3].tolist()

    def step(self, volts: float, load: float, held: bool) -> None:
        """Advance by one step; ``held`` blocks the wheel."""
        i, w, angle = self.state
        if held:
            calm = math.exp(-self.resistance / MOTOR.inductance * STEP)
            self.state = [volts / self.resistance * (1 - calm) + i * calm, 0.0, angle]
            return
        drag = -math.copysign(self.friction * MOTOR.coulomb_friction, w or volts) + load
        self.state = [
            a * i + b * w + c * angle + d * volts + e * drag for a, b, c, d, e in self.rows
        ]


def generate_commands(seconds: float, rng: np.random.Generator) -> Iterator[float]:
    """Yield a joystick-like command: ramps to levels held for some seconds."""
    volts, target, left = 0.0, 0.0, 0.0
    for _ in range(round(seconds / STEP)):
        if left <= 0:
            target = float(rng.choice([0.0, 1.0], p=[0.15, 0.85]) * rng.uniform(-10, 10))
            left = rng.uniform(0.8, 4.0)
        left -= STEP
        volts += min(max(target - volts, -0.4), 0.4)
        yield volts


def simulate_monitor(seconds, change=lambda motor, time: False, disturbed=False, seed=1):
    """Drive, and yield the time and the monitor every second."""
    rng = np.random.default_rng(seed)
    monitor, motor, count = Monitor(MOTOR), Motor(), 0
    held_until = lost_until = -1.0
    noise = rng.normal(0, 5e-3, round(seconds / STEP) + 1)
    for n, volts in enumerate(generate_commands(seconds, rng)):
        time = n * STEP
        load = 0.0
        if n % 100 == 0:
            yield time, monitor
            if change(motor, time):
                motor.change()
            if disturbed and rng.random() < 0.02:
                held_until = time + rng.uniform(0.2, 1.5)
            if disturbed and rng.random() < 0.03:
                lost_until = time + rng.uniform(0.05, 3.0)
        if disturbed:
            # The battery voltage sags with current and time; the load is a varying slope.
            volts *= (1.0 - 0.15 * time / seconds) * (1 - 0.1 * abs(motor.state[0]))
            load = 0.5 * MOTOR.coulomb_friction * math.sin(2 * math.pi * time / 97)
        motor.step(volts, load, time < held_until)
        counted = math.floor(motor.state[2] / COUNT)
        turned, count = (counted - count) * COUNT, counted
        current = motor.state[0] + float(noise[n])
        if disturbed and rng.random() < 1e-4:
            current += 3.0
        if time >= lost_until:
            monitor.add(1e9 + time + STEP, volts, current, turned)
    yield seconds, monitor


def codes(monitor: Monitor) -> set[str]:
    """Return the codes of the warnings."""
    return {f.code for f in monitor.findings()}


def test_values_stay_commissioned_and_unestimated_at_rest():
    monitor = Monitor(MOTOR)
    for n in range(1000):
        monitor.add(n * STEP, 0.0, 0.001, 0.0)
    assert monitor.values()["resistance"][0] == MOTOR.resistance
    assert {state for state, _ in monitor.validity().values()} == {"unestimated"}
    assert not monitor.findings()


def test_heated_winding_is_reported_within_20_s_of_leaving_its_band():
    def heat(motor: Motor, time: float) -> bool:
        motor.resistance = MOTOR.resistance * (1 + 0.2 * min(max(time - 30, 0) / 60, 1))
        return 30 <= time <= 91

    left = 30 + 60 * 0.15 / 0.2
    flagged = None
    for time, monitor in simulate_monitor(120.0, heat):
        if "winding_hot" in codes(monitor):
            flagged = flagged or time
        assert "magnet_weak" not in codes(monitor)
    assert left - 1 <= flagged <= left + 20
    assert monitor.values()["resistance"][0] == pytest.approx(1.2 * MOTOR.resistance, rel=0.05)
    (hot,) = monitor.findings()
    # Copper: 20 % are 51 K; the estimate may be 5 % of R off.
    assert hot.evidence["warmer"] == pytest.approx(51, abs=13)


def test_weakened_magnet_is_reported_without_a_heat_alarm():
    def weaken(motor: Motor, time: float) -> bool:
        motor.constant = MOTOR.motor_constant * (1 - 0.05 * min(max(time - 30, 0) / 60, 1))
        return 30 <= time <= 91

    for _, monitor in simulate_monitor(300.0, weaken):
        assert codes(monitor) <= {"magnet_weak"}
    assert codes(monitor) == {"magnet_weak"}


def test_tripled_friction_is_reported_without_heat_or_magnet_alarm():
    def drag(motor: Motor, time: float) -> bool:
        motor.friction = 3.0 if time >= 30 else 1.0
        return time == 30

    for _, monitor in simulate_monitor(120.0, drag):
        assert codes(monitor) <= {"friction_high"}
    assert codes(monitor) == {"friction_high"}


def test_half_an_hour_of_disturbed_driving_raises_no_alarm():
    for time, monitor in simulate_monitor(1800.0, disturbed=True):
        assert not codes(monitor), time
    assert {state for state, _ in monitor.validity().values()} == {"estimated"}


def test_inconsistent_signals_are_invalid_and_raise_no_alarm():
    rng = np.random.default_rng(0)
    monitor = Monitor(MOTOR)
    for n in range(6000):
        monitor.add(
            n * STEP, 8 * math.sin(n / 30), float(rng.normal(0, 2)), float(rng.normal(0, 3))
        )
    assert {state for state, _ in monitor.validity().values()} == {"invalid"}
    assert not monitor.findings()


def test_invalid_commissioned_values_are_refused_by_name():
    with pytest.raises(ParameterError, match="inertia"):
        replace(MOTOR, inertia=0.0)


def test_history_is_read_without_its_truncated_last_line(tmp_path):
    *_, (_, monitor) = simulate_monitor(60.0)
    file = tmp_path / "history.jsonl"
    entries = [history.entry_of(1e9 + 3600.0 * k, "front_left", monitor) for k in range(3)]
    history.append(file, entries[:2])
    history.append(file, entries[2:])
    whole = file.read_text()
    file.write_text(whole + whole[:40])
    assert history.read(file) == {"front_left": entries}
    charts = history.history_charts("front_left", entries)
    assert [c.x.tolist() for c in charts] == [[0.0, 1.0, 2.0]] * len(charts)
    file.write_text("nonsense\n" + whole)
    with pytest.raises(BagError, match="line 1"):
        history.read(file)


def test_monitoring_without_a_measured_current_is_refused():
    found = Estimate(wheel="left", model="second_order", parameters={}, combinations={})
    with pytest.raises(ParameterError, match="current"):
        read_commissioned_values(found)
