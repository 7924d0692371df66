"""Records without any noise, as a simulator writes them, are a motor's like others."""

import numpy as np
import pytest
from independent import excitation, simulate

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Hardware, Record

R, L, K, J, B, TC = 1.9, 4.0e-4, 0.0357, 2.2e-5, 0.0, 1.2e-2
TRUTH = {
    "resistance": R, "inductance": L, "motor_constant": K, "inertia": J,
    "dc_gain": K / (K**2 + R * B),
    "time_constant": (R * J + L * B) / (K**2 + R * B),
    "static_voltage": R * TC / K,
}  # fmt: skip


def _record(kind: str, signal: str, current: bool, rate: float = 500.0) -> Record:
    t = np.arange(int(8 * rate)) / rate
    v = excitation(t, kind, 9.0)
    if kind == "step":
        v[:20] = 0.0
    out = simulate(t, v, R, L, K, J, B, TC, np.zeros(t.size), 2000)
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
def test_a_record_without_noise_is_answered_as_one_with_little(kind, signal, current):
    found = estimate(_record(kind, signal, current))
    assert found.model == ("electromechanical" if current else "second_order")
    assert not [f for f in found.findings if f.code in ("current_left_out", "torque_noise")]
    values = {**found.combinations, **found.parameters}
    for name, true in TRUTH.items():
        q = values[name]
        if q.value is None or q.std is None:
            assert not current or name == "static_voltage"
            continue
        # 5 standard deviations: what is wrong silently; the simulator's steps cost 1e-4.
        assert abs(q.value - true) < max(5 * q.std, 1e-3 * true), name
