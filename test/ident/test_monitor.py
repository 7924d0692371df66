# SPDX-License-Identifier: Apache-2.0
"""The live window and its conditions for an estimate, and the monitor of a commissioned motor."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm

from smp_motor_ident.bag.window import Window
from smp_motor_ident.errors import BagError, ParameterError
from smp_motor_ident.live.demands import find_missing_excitation
from smp_motor_ident.live.monitor import CommissionedValues, Monitor, read_commissioned_values
from smp_motor_ident.record import Hardware
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


RATIO, COUNTS, WINDOW_STEP = 65.5, 500.0, 0.005
SECOND = 1_000_000_000
NOW = 10**9 * SECOND


def state(voltage, current, velocity, position, count):
    return SimpleNamespace(
        voltage=voltage, current=current, velocity=velocity, position=position, encoder_count=count
    )


def filled(seconds: float, voltage: object = None, length: float = 60.0) -> Window:
    """Return a window filled by a motor of 25 rad/s/V without lag."""
    window = Window("front_left", length)
    window.hardware = Hardware(RATIO, COUNTS, 16, 12.0)
    time = np.arange(round(seconds / WINDOW_STEP)) * WINDOW_STEP
    volts = (
        6 * np.sin(2 * np.pi * 0.83 * time) + 3 * np.sin(2 * np.pi * 2.3 * time)
        if voltage is None
        else np.broadcast_to(np.asarray(voltage, dtype=float), time.shape)
    )
    angle = np.cumsum(25 * volts) * WINDOW_STEP
    counts = np.floor(angle * COUNTS / (2 * np.pi)).astype(int)
    for t, v, a, c in zip(time, volts, angle, counts, strict=True):
        wrap_angle = (int(c) + 2**15) % 2**16 - 2**15
        window.add(NOW + round(1e9 * t), state(v, np.nan, 25 * v / RATIO, a / RATIO, wrap_angle))
    return window


def test_record_is_at_the_motor_shaft_with_counts_unwrapped():
    record = filled(20.0).record()
    assert record.current is None
    np.testing.assert_allclose(record.velocity, 25 * record.voltage, rtol=1e-12)
    assert np.abs(np.diff(record.count)).max() < 2**15
    # Counts and speed agree to one count per sample of quantisation.
    moved = np.diff(record.count) * 2 * np.pi / COUNTS / WINDOW_STEP
    assert np.abs(moved - record.velocity[1:]).max() < 2 * np.pi / COUNTS / WINDOW_STEP * 1.01


def test_voltages_equal_to_rounding_count_as_one_level():
    for volts in (12.0, -3.3, 1e-3):
        voltage = np.full(2000, volts)
        voltage[::7] = np.nextafter(volts, np.inf)
        lacks = find_missing_excitation(filled(10.0, voltage).record())
        assert "1 of 3 levels of voltage" in lacks


@pytest.mark.parametrize("volts", [np.nan, np.inf, -1e308, 1e308, 1e9])
def test_sample_with_impossible_voltage_is_discarded(volts):
    window = filled(20.0)
    before = len(window)
    window.add(NOW + 20 * SECOND, state(volts, np.nan, 0.0, 0.0, 0))
    assert len(window) == before and find_missing_excitation(window.record()) == []


def test_window_keeps_only_its_length():
    window = filled(300.0, length=10.0)
    record = window.record()
    assert record.duration == pytest.approx(10.0, abs=2 * WINDOW_STEP)  # whole samples


def test_gap_begins_a_segment_and_out_of_order_sample_is_discarded():
    window = filled(5.0)
    before = len(window)
    window.add(NOW + 2 * SECOND, state(1.0, np.nan, 0.0, 0.0, 0))
    assert len(window) == before
    for k in range(2):  # a single sample between gaps has no information
        window.add(NOW + 7 * SECOND + k * 5_000_000, state(1.0, np.nan, 0.0, 0.0, 0))
    record = window.record()
    assert record.starts == (0, before)


def test_delayed_samples_of_a_busy_machine_begin_no_segment():
    # Every fiftieth sample is taken six intervals late, and the next ones catch up.
    window = Window("front_left", 60.0)
    window.hardware = Hardware(RATIO, COUNTS, 16, 12.0)
    time = np.arange(2000) * WINDOW_STEP
    for k in range(50, 2000, 50):
        time[k : k + 8] = time[k] + 6 * WINDOW_STEP + np.arange(8) * WINDOW_STEP / 8
    for t in time:
        window.add(
            NOW + round(1e9 * t), state(3.0, 0.1, 75 / RATIO, 75 * t / RATIO, round(5968 * t))
        )
    record = window.record()
    assert record.starts == (0,)


def test_a_clock_that_was_set_back_clears_the_window():
    window = filled(5.0, length=3.0)
    window.add(NOW - 3600 * SECOND, state(1.0, np.nan, 0.0, 0.0, 0))
    assert len(window) == 1


@pytest.mark.parametrize(
    ("seconds", "voltage", "word"),
    [
        (2.0, None, "of 5 s"),
        (10.0, 0.0, "turned for 0.0"),
        (10.0, 5.0, "levels of voltage"),
        (10.0, 5.0, "changes of voltage"),
        (10.0, 5.0, "backward 0 %"),
    ],
)
def test_missing_excitation_is_named(seconds, voltage, word):
    assert word in "; ".join(find_missing_excitation(filled(seconds, voltage).record()))


def test_missing_motor_state_is_reported():
    assert find_missing_excitation(Window("w", 5.0).record()) == ["no motor_state yet"]


def test_excitation_requirements_do_not_depend_on_the_speed_unit():
    record = filled(10.0).record()
    slow = replace(record, velocity=record.velocity * 1e-6, count=None)
    assert find_missing_excitation(slow) == find_missing_excitation(record) == []


def test_excitation_requirements_are_met_without_a_speed():
    record = filled(10.0).record()
    for way in ({"count": None}, {"position": None, "hardware": Hardware()}):
        assert find_missing_excitation(replace(record, velocity=None, **way)) == []
