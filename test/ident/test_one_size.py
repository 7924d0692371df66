"""A voltage of one size, or steps of one: what is said of it, and what its intervals cover."""

import numpy as np
import pytest

from smp_motor_ident.diagnosis import one_size
from smp_motor_ident.estimate import estimate
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.record import Record

TRUTH = {"dc_gain": 15.0, "time_constant": 0.12, "static_voltage": 2.0}


def _behind(voltage: np.ndarray, put_out: np.ndarray, rng: np.random.Generator) -> Record:
    """Return a record of a motor without friction whose driver puts out something else."""
    rate, keep = 200.0, np.exp(-1 / 200.0 / TRUTH["time_constant"])
    w = np.zeros(voltage.size)
    for k in range(1, w.size):
        w[k] = keep * w[k - 1] + (1 - keep) * TRUTH["dc_gain"] * put_out[k]
    noisy = w + 0.3 * rng.standard_normal(w.size)
    return Record("motor", np.arange(w.size) / rate, voltage, velocity=noisy)


@pytest.mark.parametrize(("levels", "said"), [([8.0, -8.0], True), ([8.0, -8.0, 4.0], False)])
def test_a_voltage_of_one_size_says_that_a_clip_would_not_show(levels, said):
    rng = np.random.default_rng(12)
    voltage = np.repeat(rng.choice(levels, 40), 30)
    found = estimate(_behind(voltage, np.clip(voltage, -7.0, 7.0), rng))  # the driver's supply
    assert ("one_size_of_voltage" in [f.code for f in found.findings]) is said
    if not said:  # with another size the clip itself shows
        clip = found.combinations["clip_voltage"]
        assert abs(clip.value - 7.0) < 3 * clip.std


@pytest.mark.parametrize(("levels", "covers"), [([8.0, -8.0], True), ([8.0, -8.0, 4.0], False)])
def test_a_side_that_is_weaker_is_no_load_alone_under_one_size(levels, covers):
    """Under one size it is a load of 0.4 V and a gain of 5 % less."""
    rng = np.random.default_rng(14)
    voltage = np.repeat(rng.choice(levels, 80), 20)
    found = estimate(_behind(voltage, np.where(voltage < 0, 0.9 * voltage, voltage), rng))
    gain, lag = found.combinations["dc_gain"], found.combinations["time_constant"]
    said = [f for f in found.findings if "the intervals cover both" in f.message]
    assert [f.code for f in said] == ["asymmetry"] * covers
    if covers:
        assert 2 * gain.std < abs(gain.value - TRUTH["dc_gain"]) / 0.5 < 4 * gain.std
        assert gain.ci95[0] < TRUTH["dc_gain"] < gain.ci95[1]
        assert abs(lag.value - TRUTH["time_constant"]) < 4 * lag.std < 0.02 * lag.value


@pytest.mark.parametrize("how", ["before", "interpolated"])
def test_one_size_is_seen_however_the_command_ran(how):
    voltage = np.repeat([0.0, 8.0, -8.0, 8.0], 30)
    t = np.arange(voltage.size) / 200.0
    data = prepare([Record("motor", t, voltage, velocity=voltage)], False).held(how)
    assert one_size.size_of_voltage(data) == 8.0


def test_a_row_in_which_the_voltage_was_switched_is_no_other_size():
    voltage = np.repeat([0.0, 8.0, -8.0, 8.0], 30)
    voltage[[30, 60, 90]] = 4.0, 5.6, -4.0  # means over a switch, or over rows that were lost
    t = np.arange(voltage.size) / 200.0
    one = Record("motor", t, voltage, velocity=voltage)
    assert one_size.size_of_voltage(prepare([one], False)) == 8.0
    voltage[75] = 4.0  # between rows of one level it is a level of its own
    other = Record("motor", t, voltage.copy(), velocity=voltage)
    assert one_size.size_of_voltage(prepare([other], False)) == 0.0


def test_rows_lost_at_a_switch_of_one_size_make_no_drop_of_the_driver():
    rng = np.random.default_rng(13)
    gain, tau, friction = TRUTH.values()
    begins = np.cumsum(rng.integers(25, 45, 60))
    voltage = np.repeat([9.0, -9.0] * 30, np.diff(begins, prepend=0))
    rate, fine, w = 50.0, 50, np.zeros(voltage.size)
    keep = np.exp(-1 / rate / fine / tau)
    for k in range(1, w.size):
        w[k] = w[k - 1]
        for _ in range(fine):  # 9 V are far above friction: the motor never rests
            ahead = gain * (voltage[k] - friction * np.sign(w[k] or voltage[k]))
            w[k] = keep * w[k] + (1 - keep) * ahead
    t = np.arange(w.size) / rate
    kept = rng.random(w.size) > 0.02
    kept[begins[:-1:9]] = False  # first rows of a level among them
    noisy = w + 0.5 * rng.standard_normal(w.size)
    found = estimate(Record("motor", t[kept], voltage[kept], velocity=noisy[kept]))
    codes = [f.code for f in found.findings]
    assert "one_size_of_voltage" in codes
    assert "brush_drop" not in codes
