# SPDX-License-Identifier: Apache-2.0
"""The estimator recovers known motors, noisy or not, or reports them as unidentifiable."""

import json
from dataclasses import replace
from functools import cache, partial

import motors
import numpy as np
import pytest
from motors import excitation, simulate

from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.infer.planning import what_next
from smp_motor_ident.quality.resolution import angle_quantum
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.tune.motors import compute_torque_noise

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
# Of some fifty quantities tested one in 2000 passes four standard deviations by chance.
SIGMAS = 4.0


check = partial(motors.check, sigmas=SIGMAS, floor=1e-9)


@pytest.mark.parametrize("wheel", WHEELS)
def test_all_parameters_are_recovered_with_current_and_friction(wheel):
    result = estimate(motors.record(wheel))
    truth = motors.truth(wheel, 0.3)
    assert result.model == "electromechanical"
    assert result.identifiable
    check(result, truth, PHYSICAL)
    assert result.value("dc_gain") == pytest.approx(truth["dc_gain"], rel=5e-3)  # issue's bound
    assert result.fit_percent.validation > 95
    json.dumps(result.to_document(), allow_nan=False)


@pytest.mark.parametrize("wheel", WHEELS)
def test_voltage_and_speed_alone_identify_only_parameter_combinations(wheel):
    result = estimate(motors.record(wheel, current=False))
    truth = motors.truth(wheel, 0.3)
    assert not result.identifiable
    assert set(result.unidentifiable) == set(PHYSICAL)
    assert all(result.parameters[n].value is None for n in PHYSICAL)
    check(result, truth, ("dc_gain", "time_constant", "time_constant_product", "static_voltage"))
    assert any("current" in a for a in result.advice)


def test_a_linear_motor_is_recovered_without_friction():
    result = estimate(motors.record("front_left", static_voltage=0.0))
    check(result, motors.truth("front_left", 0.0), PHYSICAL[:5])
    q = result.parameters["coulomb_friction"]
    # Nearly zero: below a hundredth of the torque at 10 V.
    assert q.value < 0.01 * 10 * 0.011 / 12.9


@pytest.mark.parametrize("wheel", WHEELS)
@pytest.mark.parametrize("noise", [0.005, 0.05])
def test_small_torque_noise_is_not_overestimated(wheel, noise):
    """A poorer model needs more process noise; the search must return to the true level."""
    found = estimate(
        motors.record(wheel, kinds=("fourier",), seconds=20.0, current=False, torque_noise=noise)
    )
    check(found, motors.truth(wheel, 0.3), ("dc_gain", "time_constant", "static_voltage"))
    assert compute_torque_noise(found, 1 / 200) < 2.0 * noise  # [V] over a sample
    record = motors.record(wheel, current=False, torque_noise=noise)
    check(estimate(record), motors.truth(wheel, 0.3), ("dc_gain", "time_constant"))


def test_torque_noise_widens_intervals_without_parameter_bias():
    quiet = estimate(motors.record("rear_right"))
    noisy = estimate(motors.record("rear_right", torque_noise=0.5))
    truth = motors.truth("rear_right", 0.3)
    check(noisy, truth, PHYSICAL)
    assert noisy.combinations["dc_gain"].std > 3 * quiet.combinations["dc_gain"].std
    # 0.5 V of torque noise per sample against 10 V: the data still determine half a percent.
    assert noisy.value("dc_gain") == pytest.approx(truth["dc_gain"], rel=5e-3)


def test_mid_sample_command_switches_do_not_bias_the_parameters():
    fine = motors.record("front_left", rate=1000.0, seconds=5.0)
    late = np.roll(fine.voltage.reshape(-1, 5).mean(axis=1).repeat(5), 2)
    late[:2] = late[2]
    fine = motors.record("front_left", rate=1000.0, seconds=5.0, voltage=late)
    keep = slice(0, None, 5)
    mean = np.concatenate(
        [[late[0]], late[1:].reshape(-1)[: 5 * (len(late) // 5 - 1)].reshape(-1, 5).mean(axis=1)]
    )
    coarse = replace(fine, time=fine.time[keep], voltage=mean, current=fine.current[keep],
                     velocity=None, count=fine.count[keep])  # fmt: skip
    check(estimate(coarse), motors.truth("front_left", 0.3), PHYSICAL)


def test_fixed_resistance_alone_separates_no_parameters_without_current():
    result = estimate(motors.record("rear_left", current=False), fixed={"resistance": 3.2843})
    assert result.parameters["resistance"].status == "fixed"
    assert result.parameters["resistance"].value == 3.2843
    assert set(result.unidentifiable) == set(PHYSICAL) - {"resistance"}


@pytest.mark.parametrize(
    ("wheel", "friction", "model", "other", "floor", "most"),
    [
        ("rear_left", 0.0, "second_order", "inductance", 0.0, None),
        # The back-EMF is 3 % of the voltage; the bound for 12 s is 1.5 %.
        ("front_right", 0.3, "auto", "inductance", 0.0, 0.1),
        ("front_right", 0.3, "auto", "motor_constant", 1e-4, 0.01),  # of a data sheet
    ],
)
def test_two_known_parameters_make_the_others_identifiable(
    wheel, friction, model, other, floor, most
):
    truth = motors.truth(wheel, friction)
    recording = motors.record(wheel, current=False, static_voltage=friction)
    known = {n: truth[n] for n in ("resistance", other)}
    result = estimate(recording, model=model, fixed=known)
    names = [n for n in PHYSICAL[:5] if n not in known]
    motors.check(result, truth, names, sigmas=SIGMAS, floor=floor, most=most)


def test_fixed_resistance_and_viscous_friction_leave_parameters_unidentifiable():
    truth = motors.truth("front_left", 0.0)
    recording = motors.record("front_left", current=False, static_voltage=0.0)
    known = {n: truth[n] for n in ("resistance", "viscous_friction")}
    result = estimate(recording, model="second_order", fixed=known)
    # K^2 - a0 K + R b = 0 has two positive solutions, each with its own J and L.
    assert set(result.unidentifiable) >= {"motor_constant", "inertia", "inductance"}


def test_mostly_missing_current_is_not_used():
    recording = motors.record("rear_left")
    rare = np.where(np.arange(len(recording)) % 5 == 0, recording.current, np.nan)
    result = estimate(replace(recording, current=rare), model="second_order")
    assert "resistance" in result.unidentifiable
    check(result, motors.truth("rear_left", 0.3), ("dc_gain", "time_constant"))


def test_fixed_resistance_with_current_is_kept():
    truth = motors.truth("rear_left", 0.3)
    result = estimate(motors.record("rear_left"), fixed={"resistance": truth["resistance"]})
    check(result, truth, PHYSICAL[1:])
    assert result.parameters["resistance"].status == "fixed"


def test_records_with_different_initial_states_are_fitted_together():
    parts = [
        motors.record("rear_left", kinds=(k,), seed=n) for n, k in enumerate(("sine", "square"))
    ]
    result = estimate([parts[0], parts[1].slice(100, 1000)])
    check(result, motors.truth("rear_left", 0.3), PHYSICAL)
    assert result.samples == 1900


def test_differenced_speed_has_half_a_sample_of_delay():
    recording = replace(motors.record("rear_left", current=False), count=None)
    result = estimate(recording)
    truth = motors.truth("rear_left", 0.3)
    # A mean over one sample of 5 ms is late by half of it.
    late = 0.5 * result.value("averaging_window") + result.value("delay")
    assert late == pytest.approx(2.5e-3, abs=5e-4)
    assert result.value("dc_gain") == pytest.approx(truth["dc_gain"], rel=2e-3)


def test_outliers_do_not_move_a_robust_fit():
    recording = motors.record("rear_left")
    rng = np.random.default_rng(1)
    amps = recording.current.copy()
    amps[rng.integers(0, len(amps), 60)] += 5.0
    result = estimate(replace(recording, current=amps), loss="huber")
    assert result.value("resistance") == pytest.approx(3.2843, rel=0.01)


def test_proposed_recording_measures_the_current_if_it_was_missing():
    result = estimate(motors.record("rear_left", current=False))
    proposal = what_next(result, accuracy=0.01)
    assert "with the motor current measured" in proposal.words
    assert 0 < proposal.amplitude <= 12
    assert max(proposal.relative_std.values()) <= 0.0101


def test_records_without_a_signal_in_common_are_refused():
    counts = replace(motors.record(seconds=1.0), velocity=None)
    speed = replace(motors.record(seconds=1.0), count=None, source="tacho.csv")
    with pytest.raises(ParameterError, match=r"bag has no speed and tacho\.csv neither"):
        estimate([counts, speed])


@pytest.mark.parametrize(
    ("asked", "words", "current"),
    [
        ({"model": "third_order"}, "third_order", True),
        ({"fixed": {"mass": 1.0}}, "mass", True),
        ({"fixed": {"resistance": -1.0}}, "resistance = -1", True),
        ({"bounds": {"inductance": (1e-4, 1e-2)}}, "inductance", False),
        ({"bounds": {"stiffness": (0.0, 1.0)}}, "stiffness", True),
        ({"bounds": {"inertia": (2.0, 1.0)}}, "inertia", True),
    ],
)
def test_invalid_model_parameter_or_bounds_are_refused_by_name(asked, words, current):
    with pytest.raises(ParameterError, match=words):
        estimate(motors.record("rear_left", current=current), **asked)


@pytest.mark.parametrize("seed", [0, 3])
def test_square_wave_without_current_does_not_bias_the_friction(seed):
    # Stiction makes kinks; a wrong local optimum is some 15 standard deviations away.
    result = estimate(
        motors.record("front_right", current=False, kinds=("square",), seed=seed),
        model="second_order",
    )
    truth = motors.truth("front_right", 0.3)
    check(result, truth, ("dc_gain", "time_constant", "static_voltage"))


def test_load_larger_than_friction_is_estimated():
    R, L, K, J, B, TC, load = 0.56, 7.7e-5, 0.044, 7.15e-5, 7.6e-4, 0.033, 0.04
    t = np.arange(1558) / 500.0
    up = np.linspace(0.0, 3.0, 7)
    steps = np.concatenate([up, up[-2::-1], -up[1:], -up[-2::-1]])
    volts = np.resize(np.repeat(steps, 65), t.size)
    motion = simulate(t, volts, R, L, K, J, B, TC, np.full(t.size, load), 40)
    found = estimate(motors.counted(t, volts, motion[:, 2] + 2e-3, 2000.0))
    truth = {
        "dc_gain": K / (K * K + R * B),
        "static_voltage": R * TC / K,
        "load_voltage": R * load / K,
    }
    for name, true in truth.items():
        assert abs(found.combinations[name].value - true) < 0.005 * true, name


def test_the_linear_algebra_of_an_estimate_runs_on_one_thread():
    pools = pytest.importorskip("threadpoolctl")  # not with ROS 2, where apt's numpy has no threads
    seen = []

    def look(_):
        seen.extend(pool["num_threads"] for pool in pools.threadpool_info())

    with pools.threadpool_limits(2):
        estimate(motors.record("rear_left", current=False, seconds=2.0), progress=look)
        after = {pool["num_threads"] for pool in pools.threadpool_info()}
    assert set(seen) == {1} and after == {2}


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
    record = motors.counted(t, v, out[:, 2], per_turn)
    counted = estimate(record)
    angle = np.round(record.count * step + 0.3, 6)  # as a text file has it
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
