"""What no record shows is in the numbers that are stated: instruments, and loads one way."""

from collections.abc import Mapping
from dataclasses import replace

import motors
import numpy as np
import pytest

from smp_motor_ident.diagnosis import instrument_limits, systematic
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record
from smp_motor_ident.report.document import identification_document, read_identification
from smp_motor_ident.result import to_json
from smp_motor_ident.tune.designer import design
from smp_motor_ident.tune.loop import Loop

WHEEL = "rear_left"


@pytest.fixture(autouse=True)
def usual_instruments(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take of instruments what is taken of a stranger's."""
    for name in ("CURRENT_ACCURACY", "ONE_SIZE_ACCURACY"):
        monkeypatch.setattr(systematic, name, getattr(instrument_limits, name))


def deviations(found: Mapping[str, object], truth: Mapping[str, float]) -> Mapping[str, float]:
    """Return by how many stated deviations each number is off."""
    return {n: abs(q.value - truth[n]) / q.std for n, q in found.items() if n in truth and q.std}


def _recorded(scale: float = 1.0, **known: float) -> Record:
    made = motors.record(WHEEL, seconds=4.0)
    assert made.current is not None
    hardware = replace(made.hardware, **known)
    return replace(made, current=scale * made.current, hardware=hardware)


@pytest.mark.parametrize("scale", [0.95, 1.05])
def test_the_scale_of_a_current_is_in_the_interval(scale: float) -> None:
    found, truth = estimate(_recorded(scale)), motors.truth(WHEEL, 0.3)
    of_scale = {"resistance", "inductance", "inertia", "viscous_friction"}
    off = deviations(found.parameters, truth)
    assert all(1.0 < off[name] < 3.0 for name in of_scale)
    assert off["motor_constant"] < 4.0  # which the scale is not in
    for name in of_scale:
        q = found.parameters[name]
        assert q.ci95[0] < truth[name] < q.ci95[1]
        assert found.random_std(name) < 0.3 * q.std
    assert [one.cause for one in found.systematic] == ["current_scale"]


def test_a_calibrated_sensor_is_taken_at_its_word() -> None:
    exact, usual = estimate(_recorded(current_accuracy=0.0)), estimate(_recorded())
    assert not exact.systematic
    for name, q in exact.parameters.items():
        if q.std is not None:
            assert q.std == pytest.approx(usual.random_std(name), rel=1e-6), name


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


def test_what_one_size_of_voltage_hides_is_in_the_interval() -> None:
    """A volt of eight is an eighth of the gain, and nothing in the record tells."""
    found = estimate(_square([8.0, -8.0]))
    gain, lag = found.combinations["dc_gain"], found.combinations["time_constant"]
    assert gain.value == pytest.approx(15.0 * 7 / 8, rel=0.01)
    assert gain.ci95[0] < 15.0 < gain.ci95[1]
    assert lag.std > 0.09 * lag.value > 10 * found.random_std("time_constant")
    stated = estimate(_square([8.0, -8.0], voltage_accuracy=0.02)).combinations["dc_gain"]
    assert stated.std == pytest.approx(0.02 * stated.value, rel=0.05)


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
    assert static.ci95[0] <= 2.0 - load <= static.ci95[1] < 2.2
    assert [one.cause for one in found.systematic] == ["one_direction"]


def test_what_no_record_shows_is_in_the_file(tmp_path) -> None:
    found = estimate(_recorded(0.95))
    path = tmp_path / "identification.json"
    path.write_text(to_json(identification_document({WHEEL: found})), encoding="utf-8")
    read = read_identification(path)[WHEEL]
    assert read.systematic == found.systematic
    assert read.random_std("resistance") == pytest.approx(found.random_std("resistance"))
