"""Systematic uncertainty is stated beside the random one and never merged with it."""

from collections.abc import Mapping
from dataclasses import replace

import independent
import motors
import numpy as np
import pytest

from smp_motor_ident.diagnosis import instrument_limits, systematic
from smp_motor_ident.diagnosis.systematic import with_systematic
from smp_motor_ident.estimate import estimate
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.report.document import identification_document, read_identification
from smp_motor_ident.result import to_json
from smp_motor_ident.tune.designer import design
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.motors import draw_motors

WHEEL = "rear_left"


@pytest.fixture(autouse=True)
def usual_instruments(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take of instruments what is taken of a stranger's."""
    for name in ("CURRENT_ACCURACY", "ONE_SIZE_ACCURACY", "TIMING_ACCURACY"):
        monkeypatch.setattr(systematic, name, getattr(instrument_limits, name))


def deviations(found: Mapping[str, object], truth: Mapping[str, float]) -> Mapping[str, float]:
    """Return the error of each number over its total standard deviation."""
    return {
        n: abs(q.value - truth[n]) / q.total_std for n, q in found.items() if n in truth and q.std
    }


def _recorded(scale: float = 1.0, **known: float) -> Record:
    made = motors.record(WHEEL, seconds=4.0)
    assert made.current is not None
    hardware = replace(made.hardware, **known)
    return replace(made, current=scale * made.current, hardware=hardware)


@pytest.mark.parametrize("scale", [0.95, 1.05])
def test_scale_error_of_a_current_is_within_the_systematic_uncertainty(scale: float) -> None:
    found, truth = estimate(_recorded(scale)), motors.truth(WHEEL, 0.3)
    of_scale = {"resistance", "inductance", "inertia", "viscous_friction"}
    off = deviations(found.parameters, truth)
    assert all(1.0 < off[name] < 3.0 for name in of_scale)
    assert off["motor_constant"] < 4.0  # which the scale is not in
    for name in of_scale:
        q = found.parameters[name]
        assert q.total_ci95[0] < truth[name] < q.total_ci95[1]
        assert q.std < 0.3 * q.total_std
        assert not q.ci95[0] < truth[name] < q.ci95[1]
        ((cause, share),) = [(one.cause, one.share) for one in q.systematic]
        assert cause == "current_scale" and share == pytest.approx(0.03)
    assert [one.cause for one in found.systematic] == ["current_scale"]


def test_a_calibrated_sensor_is_taken_at_its_word() -> None:
    exact, usual = estimate(_recorded(current_accuracy=0.0)), estimate(_recorded())
    assert not exact.systematic
    for name, q in exact.parameters.items():
        if q.std is not None:
            assert q.std == pytest.approx(usual.parameters[name].std, rel=1e-6), name


def test_a_resistance_that_is_given_shows_the_scale() -> None:
    found = estimate(_recorded(), fixed={"resistance": motors.truth(WHEEL, 0.3)["resistance"]})
    assert found.parameters["inertia"].status == "estimated" and not found.systematic
    assert "current_scale" not in {f.code for f in found.findings}


def test_the_scale_of_a_current_leaves_the_answer_to_a_voltage_alone() -> None:
    """Gains hang on combinations, which are the same whatever the scale."""
    exact, usual = estimate(_recorded(current_accuracy=0.0)), estimate(_recorded())
    for name, q in usual.combinations.items():
        assert q.std == exact.combinations[name].std, name
    loop = Loop(sample_time=0.01, gear_ratio=65.5, counts_per_revolution=500.0)
    one, other = (design(e, loop) for e in (exact, usual))
    assert one.gains.p == pytest.approx(other.gains.p, rel=1e-6)


def _square(levels: list[float], **known: float) -> Record:
    """Return a record of a motor whose driver takes a volt of its command."""
    rng, rate, tau, gain = np.random.default_rng(12), 200.0, 0.12, 15.0
    voltage = np.repeat(rng.choice(levels, 60), 30)
    w = np.zeros(voltage.size)
    keep = np.exp(-1 / rate / tau)
    for k in range(1, w.size):
        put_out = voltage[k] - np.sign(voltage[k])
        w[k] = keep * w[k - 1] + (1 - keep) * gain * put_out
    noisy = w + 0.3 * rng.standard_normal(w.size)
    made = Record("motor", np.arange(w.size) / rate, voltage, velocity=noisy)
    return replace(made, hardware=replace(made.hardware, **known))


def test_gain_at_one_amplitude_is_sharp_and_states_where_it_holds() -> None:
    """A driver that drops 1 V of 8 V loses an eighth of the gain, unseen at one amplitude."""
    found = estimate(_square([8.0, -8.0]))
    gain, lag = found.combinations["dc_gain"], found.combinations["time_constant"]
    assert gain.value == pytest.approx(15.0 * 7 / 8, rel=0.01)
    assert gain.total_ci95[0] < 15.0 < gain.total_ci95[1]
    assert gain.std < 0.01 * gain.value and gain.valid == {"voltage": (-8.0, 8.0)}
    assert lag.total_std > 0.09 * lag.value > 10 * lag.std
    stated = estimate(_square([8.0, -8.0], voltage_accuracy=0.02)).combinations["dc_gain"]
    assert stated.total_std == pytest.approx(0.02 * stated.value, rel=0.05)


def test_levels_of_two_sizes_hide_nothing() -> None:
    found = estimate(_square([8.0, -8.0, 4.0, -4.0]))
    assert not found.systematic
    gain = found.combinations["dc_gain"]
    assert abs(gain.value - 15.0) < 4 * gain.std < 0.1 * gain.value


@pytest.mark.parametrize("load", [0.0, 1.0])
def test_one_way_the_friction_may_be_a_load(load: float) -> None:
    rng, rate, tau, gain = np.random.default_rng(13), 200.0, 0.12, 15.0
    voltage = np.repeat(rng.uniform(4.0, 9.0, 40), 40)
    w, keep = np.zeros(voltage.size), np.exp(-1 / rate / tau)
    w[0] = gain * (voltage[0] - 2.0)
    for k in range(1, w.size):
        w[k] = keep * w[k - 1] + (1 - keep) * gain * (voltage[k] - 2.0)
    noisy = w + 0.3 * rng.standard_normal(w.size)
    found = estimate(Record("motor", np.arange(w.size) / rate, voltage, velocity=noisy))
    static = found.combinations["static_voltage"]
    assert static.value == pytest.approx(2.0, abs=0.1)
    low, high = static.total_ci95
    assert low <= 2.0 - load <= high < 2.2
    assert [one.cause for one in found.systematic] == ["one_direction"]


FINE = 50


def _sampled(late: float, **known: float) -> tuple[Record, dict[str, float]]:
    """Return a record whose current shows what was, by a share of a row, and its truth."""
    step, n = 0.01, 1200
    rng = np.random.default_rng(14)
    voltage = np.repeat(rng.uniform(-10.0, 10.0, n // 4), 4)
    r, el, k, j, b, tc = 2.0, 2e-3, 0.05, 2e-4, 1e-5, 0.01
    held = np.repeat(voltage, FINE)
    t = np.arange(held.size) * step / FINE
    out = independent.simulate(t, held, r, el, k, j, b, tc, np.zeros(t.size), 2)
    ends = FINE * np.arange(1, n) - 1
    amps = out[ends - round(late * FINE), 0] + 0.01 * rng.standard_normal(n - 1)
    speed = out[ends, 1] + 0.02 * rng.standard_normal(n - 1)
    hardware = Hardware(current_accuracy=0.0, **known)
    record = Record("motor", t[ends], voltage[:-1], amps, speed, hardware=hardware)
    return record, {"inductance": el, "resistance": r, "inertia": j}


@pytest.mark.parametrize("late", [0.0, 0.02])
def test_reading_time_of_a_loop_is_a_systematic_uncertainty(late: float) -> None:
    record, truth = _sampled(late)
    found = estimate(record)
    assert not found.unreliable
    assert max(deviations(found.parameters, truth).values()) < 4.0
    inductance = found.parameters["inductance"]
    assert inductance.std < 0.3 * inductance.total_std
    assert inductance.total_std == pytest.approx(0.02 * 0.01 * truth["resistance"], rel=0.1)
    assert "timing" in {f.code for f in found.findings}


def test_a_loop_that_is_timed_better_is_taken_at_its_word() -> None:
    record, _ = _sampled(0.0, timing_accuracy=0.0)
    found = estimate(record)
    assert not found.systematic and "timing" not in {f.code for f in found.findings}


def test_a_second_lag_may_be_what_the_records_show_that_the_model_lacks() -> None:
    """Friction at reversals says that it is no filter; of a driver it says nothing."""
    rate, lag, rng = 500.0, 0.05, np.random.default_rng(15)
    voltage = np.repeat(rng.choice([-8.0, -4.0, 4.0, 8.0], 60), 40)
    r, el, k, j = 2.0, 2e-3, 0.05, lag * 0.05**2 / 2.0
    held = np.repeat(voltage, 4)
    t = np.arange(held.size) / (4 * rate)
    out = independent.simulate(t, held, r, el, k, j, 0.0, 0.02, np.zeros(t.size), 2)
    speed = out[3::4, 1] + 0.02 * rng.standard_normal(voltage.size)
    made = Record("motor", np.arange(voltage.size) / rate, voltage, velocity=speed)
    found = estimate(replace(made, hardware=Hardware(timing_accuracy=0.0)))
    assert "second_lag" in {f.code for f in found.findings} and not found.systematic
    slew = Finding("slew", "warning", "the model's error shows a driver that limits the rise")
    beside = with_systematic(replace(found, findings=(*found.findings, slew)))
    whole, product = (beside.combinations[n] for n in ("time_constant", "time_constant_product"))
    share = found.evidence("second_lag", "shift_share")
    known = found.combinations["time_constant_product"].std  # which is the share's, of the square
    second = 0.5 * (1 - np.sqrt(1 - 4 * el / r / lag))  # the shorter of both lags, of their sum
    assert abs(share - second) < 4 * known / whole.value**2
    assert whole.total_std == pytest.approx(share * whole.value / np.sqrt(3), rel=0.05)
    assert product.total_std == pytest.approx(product.value / np.sqrt(3), rel=0.05)
    assert (
        whole.total_ci95[1] == found.combinations["time_constant"].ci95[1]
    )  # it moves one way only
    # Whose of them is whose moves no gains: what the loop is of is both.
    a, b = (draw_motors(e, 200, np.random.default_rng(1)) for e in (found, beside))
    assert a is not None and b is not None
    np.testing.assert_allclose(a.a1, b.a1)


def test_systematic_uncertainty_survives_the_file(tmp_path) -> None:
    found = estimate(_recorded(0.95))
    path = tmp_path / "identification.json"
    path.write_text(to_json(identification_document({WHEEL: found})), encoding="utf-8")
    read = read_identification(path)[WHEEL]
    assert read.systematic == found.systematic
    assert read.parameters == found.parameters and read.combinations == found.combinations
