"""One step from rest with the current measured: what L/R of next to nothing would hide."""

import numpy as np
from independent import simulate

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Hardware, Record

R, L, K, J, B, TC = 0.70, 6.2e-3, 0.0182, 2.29e-4, 2.0e-4, 4.2e-3
TRUTH = {
    "resistance": R, "inductance": L, "motor_constant": K, "inertia": J,
    "dc_gain": K / (K**2 + R * B),
    "time_constant": (R * J + L * B) / (K**2 + R * B),
    "static_voltage": R * TC / K,
    "viscous_friction": B, "coulomb_friction": TC,
}  # fmt: skip


def _step(seed: int, seconds: float = 20.0) -> Record:
    """Return a step in the first row: 200 Hz, an L/R of 1.8 samples, 2000 counts a turn."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(200 * seconds)) / 200
    v = np.full(t.size, 9.35)
    out = simulate(t, v, R, L, K, J, B, TC, np.zeros(t.size), 40)
    count = np.floor(out[:, 2] * 2000 / (2 * np.pi) + rng.uniform()).astype(np.int64)
    current = out[:, 0] + 0.05 * rng.standard_normal(t.size)
    return Record("motor", t, v, current, count=count, hardware=Hardware(1.0, 2000.0))


def test_a_step_with_current_is_known_where_its_first_samples_tell_it():
    for seed in range(3):
        found = estimate(_step(seed))
        every = {**found.combinations, **found.parameters}
        for name, true in TRUTH.items():
            q = every[name]
            if q.value is None or q.std is None:
                continue
            # 5 standard deviations: what is wrong silently; of friction 1 % of the voltage besides.
            floor = 0.1 if name == "static_voltage" else 0.0
            assert abs(q.value - true) < max(5 * q.std, floor), (seed, name)
        # The inrush tells R and L, the back-EMF under it K: none may be lost to the friction.
        for name in ("resistance", "inductance", "motor_constant", "time_constant"):
            assert every[name].value is not None, (seed, name)
            assert abs(every[name].value / TRUTH[name] - 1) < 0.1, (seed, name)
