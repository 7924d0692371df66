"""A drag by the square of the speed is estimated beside the motor, as the load that it is."""

import math

import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.driver_effect import driver_of
from smp_motor_ident.model.driver import DRAG, Driver, terminal_voltage
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.designer import design
from smp_motor_ident.tune.loop import Loop

R, L, K, J, B, COULOMB = 2.0, 2e-3, 0.05, 1e-4, 2e-5, 0.01
GAIN, TAU = K / (R * B + K * K), (R * J + L * B) / (R * B + K * K)
STATIC = R * COULOMB / K
STEP, FINE = 0.005, 100


def run(
    voltage: np.ndarray,
    lost: float,
    torque_noise: float = 0.0,
    seed: int = 0,
    breakaway: float = 1.0,
) -> np.ndarray:
    """Return current and speed of a motor by fine steps of the midpoint rule.

    A drag takes as much torque at 200 rad/s as ``lost`` volts give a standing motor; ``breakaway``
    times as much as at speed rubs at rest, and falls within 10 rad/s.
    """
    drag = lost * K / R / 200.0**2
    rng, h = np.random.default_rng(seed), STEP / FINE
    i = w = 0.0
    out = np.zeros((2, voltage.size))
    for n, u in enumerate(voltage.tolist()[1:], 1):
        load = torque_noise * rng.standard_normal()
        for _ in range(FINE):
            middle = i + 0.5 * h * (u - K * w - R * i) / L
            most = COULOMB * (1.0 + (breakaway - 1.0) * math.exp(-((w / 10.0) ** 2)))
            if w == 0.0 and abs(K * middle - load) <= most:
                i += h * (u - R * middle) / L
                continue
            rubs = load + most * math.copysign(1.0, w or K * middle - load)
            half = w + 0.5 * h * (K * i - drag * w * abs(w) - B * w - rubs) / J
            i += h * (u - K * half - R * middle) / L
            after = w + h * (K * middle - drag * half * abs(half) - B * half - rubs) / J
            w = 0.0 if w * after < 0.0 else after
        out[:, n] = i, w
    return out


def steps(seed: int, seconds: float = 12.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-11.0, 11.0, int(seconds / 0.2)), 40)


def recorded(voltage: np.ndarray, lost: float, current: bool = False, **load: float) -> Record:
    amps, speed = run(voltage, lost, **load)
    noise = np.random.default_rng(9).standard_normal((2, amps.size))
    amps, speed = amps + 0.02 * noise[0], speed + 0.5 * noise[1]
    time = STEP * np.arange(voltage.size)
    return Record("motor", time, voltage, amps if current else None, velocity=speed)


def assert_true(found: Estimate, share: float = 0.02, times: float = 4.0) -> None:
    """Assert that what is stated lies within its intervals, and those are narrow."""
    truth = {
        "dc_gain": GAIN, "time_constant": TAU, "static_voltage": STATIC, "resistance": R,
        "motor_constant": K, "inertia": J, "coulomb_friction": COULOMB,
    }  # fmt: skip
    for name, q in {**found.combinations, **found.parameters}.items():
        if name in truth and q.value is not None:
            off = abs(q.value - truth[name])
            assert off < times * q.std or off < 0.002 * truth[name], name
            if name != "static_voltage" and name != "coulomb_friction":
                assert q.std < share * truth[name], name


@pytest.mark.parametrize("current", [False, True])
def test_a_motor_and_its_drag_are_both_found(current: bool) -> None:
    found = estimate(recorded(steps(1), 1.2, current))
    assert not found.unreliable
    assert_true(found)
    drag = found.combinations["quadratic_drag"]
    true = 1.2 / (200.0 / GAIN) ** 2  # volts at 200 rad/s, by those of the back-EMF there
    assert abs(drag.value - true) < 4 * drag.std < 0.2 * true
    assert "torque_noise" not in {f.code for f in found.findings}


@pytest.mark.parametrize("current", [False, True])
def test_a_motor_without_one_has_none(current: bool) -> None:
    found = estimate(recorded(steps(2), 0.0, current))
    assert "quadratic_drag" not in found.combinations
    assert_true(found)


def test_a_drag_in_a_record_of_one_size_of_voltage_is_found() -> None:
    """What a driver takes is a motor of another gain there; what the motion takes is not."""
    rng = np.random.default_rng(3)
    found = estimate(recorded(9.0 * np.repeat(rng.choice([-1.0, 1.0], 120), 20), 1.2))
    assert_true(found)
    assert found.combinations["quadratic_drag"].value > 0.0
    assert [f.code for f in found.findings].count("one_size_of_voltage") == 1


def test_a_drag_under_a_load_that_fluctuates_is_not_taken_for_a_motor_of_another_gain() -> None:
    found = estimate(recorded(steps(4), 1.2, torque_noise=0.1 * COULOMB))
    assert_true(found, share=0.1)


@pytest.mark.parametrize(("lost", "seed"), [(0.6, 5), (0.3, 7)])
def test_a_drag_that_is_neither_shown_nor_excluded_is_in_the_intervals(
    lost: float, seed: int
) -> None:
    """Where the motor never turns slowly, one of another gain and friction does the same."""
    voltage = np.repeat(np.random.default_rng(seed).uniform(4.0, 9.0, 30), 20)
    found = estimate(recorded(voltage, lost, seed=seed))
    assert "quadratic_drag" not in found.combinations and not found.unreliable
    assert any("behind a drag" in c.model for c in found.candidates)
    assert_true(found, share=0.1, times=3.0)


@pytest.mark.parametrize("current", [False, True])
def test_friction_that_falls_with_speed_is_no_drag(current: bool) -> None:
    """Both bend the line of steady speeds: as a drag it had gain and lag off by a tenth."""
    found = estimate(recorded(steps(6), 0.0, current, breakaway=2.0))
    assert "quadratic_drag" not in found.combinations
    for name, true in (("dc_gain", GAIN), ("time_constant", TAU)):
        q = found.combinations[name]
        assert abs(q.value - true) < 4 * q.std or abs(q.value - true) < 0.02 * true, name


def test_gains_are_for_the_motor_and_its_drag() -> None:
    found = estimate(recorded(steps(1), 1.2))
    assert driver_of(found).kind == DRAG
    loop = Loop(sample_time=0.01, gear_ratio=1.0, counts_per_revolution=500.0)
    one = design(found, loop)
    assert one.specification.overshoot.high < 5.0  # %


@pytest.mark.parametrize("size", [0.05, 1e6, 1e300])
def test_a_drag_of_any_size_leaves_a_voltage(size: float) -> None:
    for command, back in ((6.0, 4.0), (0.0, -4.0), (-6.0, 4.0)):
        put_out, end = terminal_voltage(Driver(DRAG, size), command, back, command, STEP)
        assert put_out == end and (command - put_out) * back > 0.0  # against the motion
        assert abs(command - put_out) <= abs(command) + abs(back)
