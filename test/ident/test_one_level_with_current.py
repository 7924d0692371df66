"""One step from rest with the current measured: what L/R of next to nothing would hide."""

import numpy as np
import pytest
from independent import simulate

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.profile import _range, one_level, profiled
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.structures import Electromechanical
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


def test_a_window_of_one_level_is_of_one_level():
    window = prepare([_step(0)], True).data_window(2.0)
    fit = initial_fit(window, Electromechanical(friction="symmetric"), Options())
    assert one_level(window, fit)


def _random_step(seed: int) -> tuple[Record, dict[str, float]]:
    """Return a step either way, 0.4 s after the beginning, of a random motor at 50 to 500 Hz."""
    rng = np.random.default_rng(seed)
    rate, tau = float(rng.choice([50, 100, 200, 500])), rng.uniform(0.05, 0.25)
    r, k, friction = rng.uniform(1, 6), rng.uniform(0.01, 0.06), rng.uniform(0.2, 0.8)
    j, el, b = tau * k * k / r, r * tau * rng.uniform(0.01, 0.05), 0.1 * k * k / r
    supply, sign = float(rng.choice([4, 6, 9])), float(rng.choice([-1, 1]))
    turn, t = int(rng.choice([28, 64, 500])), np.arange(int(4 * rate)) / rate
    v = np.where(t > 0.4, sign * supply, 0.0)
    substeps = int(max(20, 20_000 / rate))
    out = simulate(t, v, r, el, k, j, b, friction * k / r, np.zeros(t.size), substeps)
    count = np.floor(out[:, 2] * turn / (2 * np.pi) + rng.uniform()).astype(np.int64)
    current = out[:, 0] + 0.01 * supply / r * rng.standard_normal(t.size)
    stiff = r * b + k * k
    true = {
        "dc_gain": k / stiff, "time_constant": (r * j + el * b) / stiff, "static_voltage": friction,
        "time_constant_product": el * j / stiff, "resistance": r, "inductance": el,
        "motor_constant": k, "inertia": j,
    }  # fmt: skip
    hardware = Hardware(1.0, float(turn), 0, 12.0)
    return Record("motor", t, v, current, count=count, hardware=hardware), true


@pytest.mark.parametrize("seed", [3, 6, 12, 14, 16, 19, 22, 31])
def test_what_friction_and_winding_share_of_a_step_is_in_their_intervals(seed: int) -> None:
    # From rest the current must first hold what friction does: both are late.
    record, true = _random_step(seed)
    found = estimate(record)
    for name, q in {**found.combinations, **found.parameters}.items():
        if name in true and q.value is not None and q.std:
            # 5 standard deviations and 2 %: what is wrong silently.
            assert abs(q.value - true[name]) < max(5 * q.std, 0.02 * true[name]), name
    tau = found.combinations["time_constant"]
    assert tau.value is not None and abs(tau.value / true["time_constant"] - 1) < 0.1


@pytest.mark.parametrize("seed", [1, 15])
def test_a_descent_that_ended_without_friction_is_no_reason_to_believe_in_none(seed: int) -> None:
    """A motor that creeps at first and does not rub fits nearly as well as one that rubs."""
    rng = np.random.default_rng(seed)
    t = np.arange(707) / 2000.0
    voltage = np.where(t < 0.02, 0.0, 2.25)
    out = simulate(t, voltage, 0.52, 1.27e-4, 0.0292, 3e-5, 5.7e-4, 0.0324, np.zeros(t.size), 20)
    count = np.floor(out[:, 2] * 2000 / (2 * np.pi) + rng.uniform()).astype(np.int64)
    amps = out[:, 0] + 0.03 * rng.standard_normal(t.size)
    hardware = Hardware(100.0, 2000.0, 0, 5.0, None)
    found = estimate(Record("motor", t, voltage, amps, None, None, count, hardware=hardware))
    # 0.58 V in truth; what these samples like best is 0.18 V, 2 to 4 in deviance below none.
    assert found.value("static_voltage") > 0.1
    assert found.combinations["dc_gain"].ci95[1] > 25.4


@pytest.mark.parametrize("seed", [0, 1])
def test_a_profile_that_rises_slowly_ends_at_its_bound(seed: int) -> None:
    """Of a step from rest any share of what drags may be friction, of which little is tried first.

    L/R is 0.6 ms beside a time constant of 0.2 s: what breaks loose late tells nothing of it.
    """
    r, el, k, j, b, tc = 2.15, 1.338e-3, 0.03044, 9.325e-5, 1.99e-5, 8.04e-3
    rng = np.random.default_rng(seed)
    t = np.arange(8000) / 1000
    volts = np.where(t > 1.1, -4.5, 0.0)
    motion = simulate(t, volts, r, el, k, j, b, tc, np.zeros(t.size), 5)
    current = motion[:, 0] + 0.0129 * rng.standard_normal(t.size)
    speed = motion[:, 1] + 0.648 * rng.standard_normal(t.size)
    found = estimate(Record("motor", t, volts, current, velocity=speed)).combinations
    for name, true in (("dc_gain", k / (k * k + r * b)), ("static_voltage", r * tc / k)):
        low, high = found[name].ci95
        assert low < true < high, name


@pytest.mark.parametrize("seed", [0, 4])
def test_viscous_friction_that_came_out_negative_is_no_reason_to_refuse(seed: int) -> None:
    """Of friction and what grows with speed only the sum is known: the bound is far along a ridge.

    From there the gain may be what it is without either of them.
    """
    r, el, k, j, b, tc = 3.62, 2.453e-3, 0.020856, 1.306e-5, 4.848e-6, 9.824e-4
    rng = np.random.default_rng(seed)
    t = np.arange(681) / 50
    volts = np.where(t > 0.9, 3.0, 0.0)
    motion = simulate(t, volts, r, el, k, j, b, tc, np.zeros(t.size), 200)
    count = np.floor(motion[:, 2] * 2000 / (2 * np.pi) + rng.uniform()).astype(np.int64)
    current = motion[:, 0] + 0.005 * rng.standard_normal(t.size)
    found = estimate(
        Record("motor", t, volts, current, count=count, hardware=Hardware(1.0, 2000.0))
    )
    assert not found.unreliable
    low, high = found.combinations["dc_gain"].ci95
    assert low < k / (k * k + r * b) < high < 1.01 / k
    lag = found.combinations["time_constant"]
    assert abs(lag.value - (r * j + el * b) / (r * b + k * k)) < 4 * lag.std < 0.1 * lag.value


def test_no_time_at_which_a_motor_breaks_loose_tells_its_friction() -> None:
    """Sensors, clocks and stiction are late as well: friction is followed to both of its bounds."""
    data = prepare([_step(0)], True)
    fit = initial_fit(data, Electromechanical(friction="symmetric"), Options())
    assert fit is not None
    found = {p.coordinate: p for p in profiled(data, fit, Options()).profiles}["vc_plus"]
    assert [z.vc_plus for z in found.ends] == pytest.approx(_range(data, fit, "vc_plus"))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_run_down_after_all_that_is_looked_at_first_tells_friction_from_gain(seed: int) -> None:
    """One step, of which the first 12,000 rows leave open what its end, 9000 rows later, tells."""
    r, el, k, j, b, tc = 0.65, 1.33e-4, 0.0421, 5.9e-4, 1.1e-5, 0.0505
    rng = np.random.default_rng(seed)
    t = np.arange(40_000) / 5000
    volts = np.where((t >= 0.2) & (t < 4.4), 4.9, 0.0)
    motion = simulate(t, volts, r, el, k, j, b, tc, np.zeros(t.size), 4)
    count = np.floor(motion[:, 2] * 4096 / (2 * np.pi) + rng.uniform()).astype(np.int64)
    current = motion[:, 0] + 0.11 * rng.standard_normal(t.size)
    found = estimate(
        Record("motor", t, volts, current, count=count, hardware=Hardware(1.0, 4096.0))
    )
    stiff = k * k + r * b
    truth = {
        "dc_gain": k / stiff, "time_constant": (r * j + el * b) / stiff,
        "static_voltage": r * tc / k, "resistance": r, "motor_constant": k, "inertia": j,
    }  # fmt: skip
    every = {**found.combinations, **found.parameters}
    for name, true in truth.items():
        # 4 standard deviations (one in 16,000), of which each is a thousandth at most.
        assert abs(every[name].value - true) < 4 * every[name].std < 4e-3 * true, name
