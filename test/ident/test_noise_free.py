# SPDX-License-Identifier: Apache-2.0
"""Noise-free records, as from a simulator, are identified like noisy ones."""

from functools import cache

import numpy as np
import pytest
from independent import excitation, simulate

from smp_motor_ident.estimate import estimate
from smp_motor_ident.quality.resolution import angle_quantum
from smp_motor_ident.record import Hardware, Record

R, L, K, J, B, TC = 1.9, 4.0e-4, 0.0357, 2.2e-5, 0.0, 1.2e-2
TRUTH = {
    "resistance": R, "inductance": L, "motor_constant": K, "inertia": J,
    "dc_gain": K / (K**2 + R * B),
    "time_constant": (R * J + L * B) / (K**2 + R * B),
    "static_voltage": R * TC / K,
}  # fmt: skip


@cache
def _motion(kind, seconds, rate=500.0):
    """Return time, voltage, and the motor's current, speed and angle."""
    t = np.arange(int(seconds * rate)) / rate
    v = excitation(t, kind, 9.0)
    return t, v, simulate(t, v, R, L, K, J, B, TC, np.zeros(t.size), 2000)


def _record(kind: str, signal: str, current: bool) -> Record:
    t, v, out = _motion(kind, 8.0 if signal == "counts" else 4.0)  # longer for 64 counts a turn
    motion: dict[str, np.ndarray] = {
        "counts": {"count": np.floor(out[:, 2] * 64 / (2 * np.pi)).astype(np.int64)},
        "speed": {"velocity": out[:, 1].copy()},
        "angle": {"position": out[:, 2].copy()},
    }[signal]
    counted = 64.0 if signal == "counts" else None
    return Record("motor", t, v, out[:, 0].copy() if current else None,
                  hardware=Hardware(1.0, counted), **motion)  # fmt: skip


@pytest.mark.parametrize("current", [True, False])
@pytest.mark.parametrize("signal", ["counts", "speed", "angle"])
@pytest.mark.parametrize("kind", ["square", "fourier"])
def test_noise_free_record_is_identified_without_bias(kind, signal, current):
    found = estimate(_record(kind, signal, current))
    assert found.model == ("electromechanical" if current else "second_order")
    assert not [f for f in found.findings if f.code in ("current_left_out", "torque_noise")]
    values = {**found.combinations, **found.parameters}
    for name, true in TRUTH.items():
        q = values[name]
        if q.value is None or q.std is None:
            assert not current or name == "static_voltage"
            continue
        # 5 standard deviations count as a silent error; the simulator's steps cost 1e-4.
        assert abs(q.value - true) < max(5 * q.std, 1e-3 * true), name


@pytest.mark.parametrize("per_turn", [28.0, 500.0])
def test_quantised_angle_is_treated_as_counts(per_turn):
    t = np.arange(4000) / 500.0
    v = excitation(t, "fourier", 9.0)
    out = simulate(t, v, R, L, K, J, B, TC, np.zeros(t.size), 100)
    step = 2 * np.pi / per_turn
    count = np.floor(out[:, 2] / step).astype(np.int64)
    counted = estimate(Record("motor", t, v, count=count, hardware=Hardware(1.0, per_turn)))
    angle = np.round(count * step + 0.3, 6)  # as a text file has it
    found = estimate(Record("motor", t, v, position=angle))
    assert found.model == counted.model
    for name, q in counted.combinations.items():
        assert found.combinations[name].value == pytest.approx(q.value, abs=0.02 * (q.std or 0.0))


@pytest.mark.parametrize("decimals", [6, 5])
def test_angle_quantum_is_found_in_a_log_of_seven_digits(decimals):
    """With 2000 counts and a gear of 50 the last digit is a sixth of a count."""
    rng = np.random.default_rng(3)
    step = 2 * np.pi / 2000 / 50
    t = np.arange(8000) / 500
    turned = np.cumsum(0.012 * (1 - np.cos(t)))
    logged = np.round(step * np.floor(turned / step), decimals)
    assert angle_quantum(logged) == pytest.approx(step, rel=1e-4)
    # Noise of a third of a count hides the quantum.
    assert angle_quantum(turned + 0.3 * step * rng.standard_normal(t.size)) == 0.0


def test_smooth_angle_has_no_quantum():
    rng = np.random.default_rng(0)
    t = np.arange(5000) / 200
    for _ in range(50):
        angle = rng.uniform(0.05, 5) * np.cumsum(np.sin(rng.uniform(0.1, 3) * t)) * 0.1
        for noise in (0.0, 1e-4, 1e-3):
            assert angle_quantum(angle + noise * rng.standard_normal(t.size)) == 0.0
