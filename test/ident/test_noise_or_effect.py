"""What a load that fluctuates would swallow is named, and a load that fluctuates is left alone."""

from __future__ import annotations

import math
from dataclasses import replace

import independent
import motors
import numpy as np
import pytest

from smp_motor_ident.diagnosis import noise_or_effect
from smp_motor_ident.diagnosis.effects import EFFECTS
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.structures import SecondOrder
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.result import Estimate

RESISTANCE, LAG, CONSTANT, INERTIA, VISCOUS = independent.TABLE_1["rear_left"]
STATIC = 0.3
TURN = 5000.0  # counts
GEAR = 65.5


def dragged(share: float, *, current: bool, seed: int = 3) -> Record:
    """Random steps of a motor with a drag that takes a share of what friction does at 8 V."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-10.0, 10.0, 40), 25)
    t = np.arange(voltage.size) / 200
    coulomb = STATIC * CONSTANT / RESISTANCE
    fastest = 8.0 * CONSTANT / (RESISTANCE * VISCOUS + CONSTANT**2)
    drag = share * (coulomb + VISCOUS * fastest) / fastest**2
    load = np.zeros(t.size)
    for _ in range(12):  # the speed is that which the load itself slows
        out = independent.simulate(
            t, voltage, RESISTANCE, LAG, CONSTANT, INERTIA, VISCOUS, coulomb, load, 50
        )
        middle = 0.5 * (out[:, 1] + np.concatenate([[0.0], out[:-1, 1]]))
        load = drag * middle * np.abs(middle)
    count = np.floor(out[:, 2] * TURN / (2 * np.pi) + rng.uniform()).astype(np.int64)
    amps = out[:, 0] + 0.01 * rng.standard_normal(t.size) if current else None
    return Record(
        "rear_left", t, voltage, amps, None, None, count,
        hardware=Hardware(GEAR, TURN, 0, 12.0, None), source="bag",
    )  # fmt: skip


def lifting(share: float, seed: int = 4) -> Record:
    """Random steps of a motor that lifts an arm, whose weight is a share of 8 V."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-10.0, 10.0, 60), 25)
    t = np.arange(voltage.size) / 200
    coulomb = STATIC * CONSTANT / RESISTANCE
    load = np.zeros(t.size)
    for _ in range(12):  # the angle is that to which the load itself lets the arm swing
        out = independent.simulate(
            t, voltage, RESISTANCE, LAG, CONSTANT, INERTIA, VISCOUS, coulomb, load, 50
        )
        middle = 0.5 * (out[:, 2] + np.concatenate([[0.0], out[:-1, 2]]))
        load = share * 8.0 * CONSTANT / RESISTANCE * np.sin(middle / GEAR + 0.4)
    count = np.floor(out[:, 2] * TURN / (2 * np.pi)).astype(np.int64)
    hardware = Hardware(GEAR, TURN, 0, 12.0, None)
    return Record("rear_left", t, voltage, count=count, hardware=hardware, source="bag")


@pytest.mark.parametrize(
    ("kind", "share", "seed"), [("fourier", 0.15, 1), ("fourier", 0.5, 2), ("square", 1.0, 2)]
)
def test_no_current_is_given_up_under_a_load_that_wanders(
    kind: str, share: float, seed: int
) -> None:
    """R, L and K show in the voltage alone, whatever the load: an angle that fits tells less."""
    rng = np.random.default_rng(seed)
    t = np.arange(600) / 200
    voltage = independent.excitation(t, kind, 10.0)
    kept = np.exp(-t[1] / 0.1)
    wander = np.zeros(t.size)
    for n in range(t.size):
        wander[n] = kept * wander[n - 1] + np.sqrt(1 - kept**2) * rng.standard_normal()
    volts = CONSTANT / RESISTANCE
    out = independent.simulate(
        t, voltage, RESISTANCE, LAG, CONSTANT, INERTIA, VISCOUS, STATIC * volts,
        share * volts * wander, 50,
    )  # fmt: skip
    amps = out[:, 0] + 0.01 * rng.standard_normal(t.size)
    angle = out[:, 2] + 2e-3 * rng.standard_normal(t.size)
    found = estimate(Record("rear_left", t, voltage, amps, position=angle, source="bag"))
    assert found.model == "electromechanical" and not found.unreliable
    truth = {"resistance": RESISTANCE, "inductance": LAG, "motor_constant": CONSTANT}
    for name, value in truth.items():
        q = found.parameters[name]
        assert abs(q.value - value) < 4 * q.std, name
        assert abs(q.value - value) < 0.01 * value, name


def test_a_weight_that_a_motor_lifts_is_named() -> None:
    arm = lifting(0.2)
    assert 1.0 < np.ptp(arm.count) * 2 * np.pi / TURN / GEAR < 2 * np.pi  # it swings
    found = estimate(arm)
    assert {f.code: f.severity for f in found.findings}["gravity"] == "warning"
    gain = found.combinations["dc_gain"]
    assert abs(gain.value - CONSTANT / (RESISTANCE * VISCOUS + CONSTANT**2)) < 3 * gain.std


def severities(found: Estimate) -> dict[str, str]:
    """Return how severe each effect is that is spoken of."""
    codes = {effect.code for effect in EFFECTS}
    return {f.code: f.severity for f in found.findings if f.code in codes}


@pytest.fixture
def nothing_sought(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let an estimate end where its model's error is named, nothing estimated beside the motor."""
    monkeypatch.setattr("smp_motor_ident.diagnosis.alternatives.likeliest", lambda *_: None)


@pytest.mark.usefixtures("nothing_sought")
@pytest.mark.parametrize("current", [False, True])
def test_a_drag_is_not_taken_for_a_load_that_fluctuates(current: bool) -> None:
    found = estimate(dragged(0.1, current=current))
    assert "torque_noise" in {f.code for f in found.findings}
    assert severities(found)["drag"] == "warning"
    gain = found.combinations["dc_gain"]  # beside a drag it is that of the slowest speeds
    true = CONSTANT / (RESISTANCE * VISCOUS + CONSTANT**2)
    assert 0.01 * true < abs(gain.value - true) < 2 * gain.std
    assert set(severities(estimate(dragged(0.0, current=current))).values()) <= {"note"}


@pytest.mark.usefixtures("nothing_sought")
def test_a_drag_is_a_torque_where_the_current_is_measured() -> None:
    # A voltage would take the drag's part of the current along: then no number would move by it.
    found = estimate(dragged(0.2, current=True))
    (drag,) = (f for f in found.findings if f.code == "drag" and f.severity == "warning")
    friction = found.parameters["viscous_friction"]
    assert drag.evidence["quantity"] == "viscous_friction"
    # What the finding says it is off by is what it is off by.
    off = abs(friction.value - VISCOUS) / friction.value
    np.testing.assert_allclose(drag.evidence["shift_share"], off, rtol=0.15)
    assert abs(friction.value - VISCOUS) < 2 * friction.std


@pytest.mark.parametrize("seed", range(4))
def test_a_load_that_fluctuates_shows_no_effect(seed: int) -> None:
    made = motors.record("rear_left", current=bool(seed % 2), torque_noise=0.5, seed=seed)
    found = estimate(made)
    assert "torque_noise" in {f.code for f in found.findings}
    assert "unreliable" not in severities(found).values()


def test_a_current_offset_is_found_beside_an_offset_of_the_driver() -> None:
    """A driver's offset is a load and an offset of the current at once, neither alone."""
    asked = independent.excitation(np.arange(3000) / 200, "square", 6.0)
    made = motors.record("rear_left", voltage=asked + 0.2, static_voltage=0.3, seconds=5.0)
    found = estimate(replace(made, voltage=asked, velocity=None))
    true = motors.truth("rear_left", 0.3)
    for name in ("inductance", "resistance", "motor_constant", "time_constant"):
        q = {**found.combinations, **found.parameters}[name]
        assert abs(q.value - true[name]) < 4.5 * q.std, name
    load = found.combinations["load_voltage"]
    assert abs(load.value + 0.2) < 4.5 * load.std


def test_an_offset_beyond_friction_is_found_although_neither_half_of_it_helps() -> None:
    """A speed loop's integrator holds the motor at rest against its driver's offset."""
    R, L, K, J, B, TC, off = 3.82, 0.00195, 0.00444, 2.69e-7, 1.3e-7, 1.95e-4, 0.36
    rng = np.random.default_rng(0)
    levels = rng.permutation([550.0, 0.0, 760.0, -370.0, 550.0, 0.0, -370.0, 200.0])
    asked = np.repeat(levels, 94)[:745]
    command = np.zeros(asked.size + 1)
    motion = np.zeros((asked.size, 2))
    seen = integral = i = w = 0.0
    for n, goal in enumerate(asked):
        motion[n] = i, w
        seen += 0.5 * (w - seen)
        command[n + 1] = 0.00355 * (goal - seen) + integral
        integral += 6.4e-5 * (goal - seen)
        for _ in range(100):  # of 0.1 ms: the current exact, the speed by a step
            steady = (command[n + 1] + off - K * w) / R
            i = steady + (i - steady) * np.exp(-1e-4 * R / L)
            if w == 0.0 and abs(K * i) <= TC:
                continue
            faster = w + 1e-4 * (K * i - TC * np.sign(w or i) - B * w) / J
            w = 0.0 if faster * w < 0 else faster
    t = np.arange(asked.size) / 100
    speed = motion[:, 1] + 5.0 * rng.standard_normal(t.size)
    current = motion[:, 0] + 0.005 * rng.standard_normal(t.size)
    found = estimate(Record("motor", t, command[:-1], velocity=speed, current=current)).combinations
    assert abs(found["load_voltage"].value + off) < 5 * found["load_voltage"].std < 0.02 * off
    assert abs(found["dc_gain"].value - K / (K * K + R * B)) < 5 * found["dc_gain"].std < 2.0


def test_friction_that_varies_over_a_turn_of_the_output_is_no_driver_at_few_steady_speeds() -> None:
    gain, lag, friction, step = 5.0, 0.0265, 2.2, 0.005
    volts = np.repeat(24.0 * np.array([0, 0.25, 0.4, 0.55, 0.7, 0.85, 1, 0.5]), 200)
    angle, speed, shown = 0.0, 0.0, []
    for u in volts:
        towards = gain * (u - friction * (1 + 0.1 * np.sin(angle / 50 + 4.19)))
        after = max(towards + (speed - towards) * math.exp(-step / lag), 0.0)
        angle, speed = angle + step * (speed + after) / 2, after
        shown.append(speed)
    noise = np.random.default_rng(8).normal(0.0, 0.6, volts.size)
    found = estimate(Record("motor", step * np.arange(volts.size), volts, velocity=shown + noise))
    for name, true in (("dc_gain", gain), ("static_voltage", friction), ("time_constant", lag)):
        q = found.combinations[name]
        assert abs(q.value - true) < 4 * q.std, name  # 19, 11 and 5 behind a supply that sagged


def test_a_step_out_of_all_bounds_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    data = prepare([motors.record("rear_left", current=False, seconds=2.0)], False)
    fit = initial_fit(data, SecondOrder(), Options())
    assert fit is not None
    here = noise_or_effect._linearised(data, fit, EFFECTS[:1], 1.0)
    assert here is not None
    for step, taken in ((1e-3, True), (1e5, False)):
        sizes = np.full(here.length.size, step)
        sizes[here.own :] = 0.0
        monkeypatch.setattr(type(here), "fitted", lambda *_, s=sizes: (s, 0.0))
        assert (here.moved(0.0, EFFECTS[0], 1.0) is not None) is taken
