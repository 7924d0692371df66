"""Gains hold on the drive that was identified: its sensor, its friction, and what is not known."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from smp_motor_control.wheel.loop import WheelLoop
from smp_motor_ident.cli import tuning
from smp_motor_ident.cli.tune import main as tune
from smp_motor_ident.cli.tune import parser
from smp_motor_ident.errors import DesignError
from smp_motor_ident.estimate import estimate as identify
from smp_motor_ident.finding import Finding
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.report.document import identification_document
from smp_motor_ident.result import Estimate, FitPercent, ModelError, Quantity, ResidualTests
from smp_motor_ident.tune import Loop, design
from smp_motor_ident.tune.case import prepare
from smp_motor_ident.tune.motors import eccentric_of, torque_noise_of
from smp_motor_ident.tune.verification import loop_settings
from smp_motor_ident.tune.writing import parameters

MOTOR = {"dc_gain": 25.0, "time_constant": 0.05, "time_constant_product": 6e-4}
LOOP = Loop(sample_time=0.01, delay=0.01, gear_ratio=1.0, counts_per_revolution=2000.0)
DOUBT = Finding("dead_zone", "unreliable", "a dead zone of 2 V", {}, "record slow ramps")


def estimate(std: float = 0.01, findings=(), **more) -> Estimate:
    values = {**MOTOR, "static_voltage": 0.4, **more}
    deviations = [std * v for v in values.values()]
    return Estimate(
        "front_left",
        "second_order",
        {},
        {n: Quantity(v, s) for (n, v), s in zip(values.items(), deviations, strict=True)},
        tuple(values),
        np.diag(np.square(deviations)),
        FitPercent(97.0, 96.0),
        findings=tuple(findings),
        sample_time=0.01,
        hardware=Hardware(1.0, 2000.0, 0, 12.0),
    )


def change(one, motor, window=0.0, lag=0.0, share=0.5, seconds=2.0):
    """Return time and speed of a change of set-point, integrated in small steps.

    The controller is written from the published rules of the running one; friction acts on the
    voltage's side.
    """
    T, sub = one.loop.sample_time, 50
    h = T / sub
    gains, plan, model = one.gains, one.reference, one.motor
    steps = int(seconds / T)
    target = share * plan.max_velocity
    profile = plan.profile()
    profile.set_target(target, T)
    path = [profile.ahead(k * T) for k in range(steps + 1)]
    r = np.array([p.velocity for p in path])
    a = np.array([p.acceleration for p in path])
    time = T * np.arange(steps)
    bend = model["time_constant_product"] / model["time_constant"]
    forward = gains.feedforward_velocity * (0.5 * (r[1:] + r[:-1]) - T / 12 * np.diff(a))
    forward += gains.feedforward_acceleration * (np.diff(r) + bend * np.diff(a)) / T
    forward += gains.feedforward_static
    late = [plan.lag + plan.doubt, plan.lag, max(plan.lag - plan.doubt, 0.0)]
    around = np.array([np.interp(time - x, time, r[:-1]) for x in late])
    gain, tau, tp, friction = (
        motor[n] for n in ("dc_gain", "time_constant", "time_constant_product", "static_voltage")
    )
    speed = rate = filtered = angle = integral = before = slope = 0.0
    angles, sent, out = [0.0], [0.0] * (round(one.loop.loop_delay / T) + 1), np.empty(steps)
    for k in range(steps):
        if lag:
            y = filtered
        else:
            back = max(round((window or T) / h), 1)
            y = (angles[-1] - (angles[-1 - back] if len(angles) > back else 0.0)) / (back * h)
        low, high = around[:, k].min(), around[:, k].max()
        e = min(max(y, low), high) - y
        tf = gains.derivative_filter_time_constant
        weighted = gains.setpoint_weight_d * (e + y) - y
        slope = (tf * slope + weighted - before) / (tf + T)
        before = weighted
        wanted = gains.p * (gains.setpoint_weight_p * (e + y) - y) + integral + gains.d * slope
        wanted += forward[k]
        given = min(max(wanted, -12.0), 12.0)
        integral += T * (gains.i * e + (given - wanted) / gains.tracking_time_constant)
        sent = [given, *sent[:-1]]
        out[k] = speed
        for _ in range(sub):
            pull = sent[-1] - motor.get("load_voltage", 0.0)
            drive = pull - math.copysign(friction, speed) if speed else max(pull - friction, 0.0)
            rate += h * (gain * drive - speed - tau * rate) / tp
            speed = max(speed + h * rate, 0.0)
            rate = rate if speed > 0 or drive > 0 else 0.0
            filtered += h * (speed - filtered) / lag if lag else 0.0
            angle += h * speed
            angles.append(angle)
    return time, out / target


def overshoot(one, motor, **sensor) -> float:
    return 100 * (change(one, motor, **sensor)[1].max() - 1)


TRUE = {**MOTOR, "static_voltage": 0.4}


@pytest.mark.parametrize(
    ("sensor", "name"), [({"window": 0.05}, "averaging_window"), ({"lag": 0.04}, "sensor_lag")]
)
def test_gains_are_of_the_speed_that_the_firmware_reports(sensor, name):
    value = next(iter(sensor.values()))
    aware, ignorant = design(estimate(**{name: value}), LOOP), design(estimate(), LOOP)
    # A quarter of a percent: the test's integration in steps of a fiftieth.
    assert overshoot(aware, TRUE, **sensor) <= aware.specification.overshoot.high + 0.25
    assert overshoot(aware, TRUE, **sensor) < 2.0
    assert overshoot(ignorant, TRUE, **sensor) > 3.0
    assert aware.reference.lag == pytest.approx(
        0.01 + (value / 2 if name == "averaging_window" else value)
    )


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_a_lag_that_may_be_the_sensors_overshoots_no_change(share):
    """The motor is ahead of a filter: led as if the lag were its own, it leaves its bands."""
    doubt = Finding("second_lag", "warning", "two lags, the second 0.5 of the first")
    lags = {"time_constant": 0.15, "time_constant_product": 0.1 * 0.05}
    filtered = {**TRUE, "time_constant": 0.1, "time_constant_product": 1e-4}
    aware = design(estimate(findings=[doubt], **lags), LOOP)
    ignorant = design(estimate(**lags), LOOP)
    stated = ignorant.specification.overshoot.high
    assert overshoot(ignorant, filtered, lag=0.05, share=share) > stated + 5.0
    for motor, lag in ((filtered, 0.05), ({**TRUE, **lags}, 0.0)):
        over = overshoot(aware, motor, lag=lag, share=share)
        assert over <= aware.specification.overshoot.high + 0.25
        assert over < 4.0
    assert any("filter" in words for words in aware.warnings)


def test_changes_are_no_faster_than_the_driver():
    """Nor late: a driver that ramps follows what is fed forward, whatever the change."""
    size = {"quantity": "slew_rate", "size": 40.0, "full_duty": 12.0, "emf_share": 1.0}
    slewed = Finding("slew", "warning", "a driver that ramps", size)
    one = design(estimate(findings=[slewed]), LOOP)
    plan, gains, T = one.reference, one.gains, LOOP.sample_time
    for begin, end in ((0.0, 0.5), (0.0, 0.05), (1.0, -1.0), (-0.9, -0.2)):
        profile = plan.profile()
        profile.reset(begin * plan.max_velocity)
        profile.set_target(end * plan.max_velocity, T)
        path = [profile.ahead(k * T) for k in range(int(3.0 / T))]
        volts = [gains.feedforward_velocity * p.velocity + gains.feedforward_acceleration
                 * p.acceleration for p in path]  # fmt: skip
        assert np.abs(np.diff(volts)).max() <= 40.0 * T
        assert path[-1].velocity == pytest.approx(end * plan.max_velocity)
    assert plan.lag == design(estimate(), LOOP).reference.lag
    assert one.loop.loop_delay == pytest.approx(0.01 + 0.5 * 12.0 / 40.0)
    assert one.specification.overshoot.high < 5.0


def test_changes_leave_room_for_a_load_that_the_recording_shows():
    plain, uphill = (design(estimate(load_voltage=x), LOOP) for x in (0.0, -2.0))
    less = plain.reference.drive.top_speed - uphill.reference.drive.top_speed
    assert less == pytest.approx(2.0 * MOTOR["dc_gain"])
    assert uphill.reference.max_velocity < plain.reference.max_velocity


def test_bands_hold_a_load_that_friction_held_before_the_change():
    """Feed-forward knows of friction alone: the integral has the load still to find."""
    uphill = {**TRUE, "load_voltage": 0.35}
    aware, ignorant = design(estimate(load_voltage=0.35), LOOP), design(estimate(), LOOP)
    time, speed = change(aware, uphill)
    settling = time[np.flatnonzero(np.abs(speed - 1) > 0.02)[-1] + 1]
    assert settling > ignorant.specification.settling.high + LOOP.sample_time
    assert settling <= aware.specification.settling.high
    downhill = overshoot(aware, {**TRUE, "load_voltage": -0.35})
    assert ignorant.specification.overshoot.high + 1.0 < downhill
    assert downhill <= aware.specification.overshoot.high + 0.25


def test_commands_that_came_late_by_scatter_are_no_load_but_widen_what_a_change_does():
    rough = 0.02 * MOTOR["dc_gain"] / MOTOR["time_constant"]  # 0.02 V sqrt(s)
    load = Finding("torque_noise", "warning", "", {"acceleration": rough})
    late = Finding("command_jitter", "note", "", {"scatter": 3e-3, "as_noise": 0.0199})
    assert torque_noise_of(estimate(findings=[load]), 0.01) == pytest.approx(0.2)
    assert torque_noise_of(estimate(findings=[load, late]), 0.01) < 0.03
    shaken, scattered, exact = (
        design(estimate(findings=f), LOOP, transition_time=0.05) for f in ([load], [load, late], [])
    )
    assert math.isnan(shaken.specification.settling.high)
    assert math.isfinite(scattered.specification.settling.high)
    assert scattered.specification.settling.high > exact.specification.settling.high
    assert scattered.specification.overshoot.high > exact.specification.overshoot.high
    assert scattered.reference.doubt == pytest.approx(3e-3)  # and is no slower than it must
    arrivals = Finding("arrival_beat", "note", "", {"latency": 3e-3})
    assert design(estimate(findings=[arrivals]), LOOP).reference.doubt == pytest.approx(3e-3)


def test_bands_hold_an_encoder_that_is_off_once_a_turn_as_the_recording_shows():
    """Of an amplitude of a count in 1000 samples: a sine's mean square over a rounding's."""
    count = 2 * math.pi / 32
    explained = 1000 * (count**2 / 2) / (count**2 / 12)
    off = Finding("encoder_error", "note", "", {"explained_deviance": explained})
    counts = replace(LOOP, counts_per_revolution=32.0)
    found = [replace(estimate(findings=f), samples=1000) for f in ([], [off])]
    assert eccentric_of(found[1], counts) == pytest.approx(count)
    true, shaken = (design(one, counts, transition_time=0.1).specification for one in found)
    assert shaken.overshoot.high > true.overshoot.high + 1.0
    load = Finding("torque_noise", "warning", "", {"acceleration": 1.0})
    assert eccentric_of(replace(found[1], findings=(off, load)), counts) == 0.0


def test_bands_hold_a_load_that_fluctuates_as_the_recording_shows():
    """A speed that wanders with a deviation s reaches several s beyond the change."""
    rough = 0.5 * MOTOR["dc_gain"] / MOTOR["time_constant"] * 0.1  # 0.5 V over 10 ms
    noise = Finding("torque_noise", "warning", "a load that fluctuates", {"acceleration": rough})
    steady, shaken = (design(estimate(findings=f), LOOP) for f in ([], [noise]))
    wander = 100 * rough * math.sqrt(0.5 * MOTOR["time_constant"]) / shaken.specification.change
    more = shaken.specification.overshoot.high - steady.specification.overshoot.high
    assert 1.0 * wander < more < 6.0 * wander  # of the speed without a loop, which takes some off
    springs = ResidualTests(model_error=ModelError((30.0, 200.0), (0.0, 3.0), (0.1, 3.5)))
    assert torque_noise_of(replace(estimate(findings=[noise]), residuals=springs), 0.01) == 0.0


def test_outliers_do_not_reach_the_loop():
    """Of a speed whose noise is known: two in a hundred, most of them within half of the top."""
    found = Finding("glitches", "warning", "", {"signal": "velocity", "samples": 20.0})
    counts = replace(LOOP, counts_per_revolution=None, speed_noise=1.0, difference_window=0)
    one = design(replace(estimate(findings=[found]), samples=1000), counts)
    alike = one.reference.transition_time
    quiet = design(replace(estimate(), samples=1000), counts, transition_time=alike)
    assert one.specification.overshoot.high > quiet.specification.overshoot.high
    written = parameters(one)
    assert written["implausible_jump"] == pytest.approx(8.0)
    loop = WheelLoop(loop_settings(written))
    rng, true, T = np.random.default_rng(5), 0.0, LOOP.sample_time
    lost, believed = [], []
    for k in range(6000):
        volts = 11.0 if k // 60 % 2 else -11.0  # as fast as it can, there and back
        true += (MOTOR["dc_gain"] * volts - true) * -math.expm1(-T / MOTOR["time_constant"])
        outlier = rng.random() < 0.02
        reading = true + rng.normal() + outlier * rng.uniform(-250.0, 250.0)
        off = abs(reading - true)
        taken = not math.isnan(loop.speed(T, reading, 0, volts))
        if outlier and k % 60 > 20 and off > 40.0:  # where it is steady
            believed.append(taken)
        elif not outlier:
            lost.append(not taken)
    assert np.mean(lost) < 0.005 and len(believed) > 20 and np.mean(believed) < 0.1


def test_counts_that_replace_an_observer_are_differenced_as_long_as_the_loop_bears():
    """Over one sample a count of 48 would be 65 rad/s, of which an observer's gains make 12 V."""
    fast = replace(LOOP, sample_time=0.002, delay=0.002, speed_source="observer")
    for counts, longer in ((48.0, True), (1e5, False)):
        one = design(estimate(), replace(fast, counts_per_revolution=counts))
        window = parameters(one)["difference_window"]
        assert (window > 1) is longer
        assert window == 1 or window * 0.002 <= one.margins.delay
        volts = one.gains.p * 2 * math.pi / counts / (window * 0.002)
        assert volts < 0.25 * 12.0 and (volts * window > 0.5 * 12.0) is longer
    given = replace(fast, counts_per_revolution=48.0, averaging_given=True)
    assert parameters(design(estimate(), given))["difference_window"] == 1


def test_gains_from_one_size_of_voltage_hold_at_others():
    """A driver that is clipped where it was recorded has a fifth more gain at half the speed."""
    level = Finding("one_size_of_voltage", "warning", "the voltage has one size, 12 V")
    aware, ignorant = design(estimate(findings=[level]), LOOP), design(estimate(), LOOP)
    more = {**TRUE, "dc_gain": 1.2 * TRUE["dc_gain"]}
    assert overshoot(ignorant, more) > ignorant.specification.overshoot.high + 2.0
    assert overshoot(aware, more) <= aware.specification.overshoot.high + 0.25
    assert aware.robustness.holds >= 0.99 and aware.gains.i < ignorant.gains.i
    assert any("one size" in words for words in aware.warnings)


def test_drives_within_the_uncertainty_stay_within_the_specified_bands():
    one = design(estimate(std=0.03), LOOP)
    spec, rng, held = one.specification, np.random.default_rng(8), []
    for _ in range(40):
        true = {n: v * math.exp(0.03 * rng.normal()) for n, v in TRUE.items()}
        time, speed = change(one, true)
        outside = np.flatnonzero(np.abs(speed - 1) > 0.02)
        settled = time[outside[-1] + 1]
        held.append(
            100 * (speed.max() - 1) <= spec.overshoot.high + 0.25
            and settled <= spec.settling.high + LOOP.sample_time
        )
    # 300 draws leave a share of 1/300 on each side; of 40 at most one by chance (99.2 %).
    assert sum(held) >= 39
    assert spec.settling.low <= one.performance.settling <= spec.settling.high
    assert spec.phase_margin.low >= 0.99 * 60
    assert spec.samples == 300


def test_unreliable_identification_is_refused_and_widens_what_is_designed_on_it():
    with pytest.raises(DesignError, match=r"unreliable: a dead zone of 2 V \(record slow ramps\)"):
        design(estimate(findings=[DOUBT]), LOOP)
    sure = design(estimate(), LOOP)
    wide = design(estimate(findings=[DOUBT]), LOOP, accept_unreliable=True)
    assert wide.gains.i < 0.95 * sure.gains.i
    assert wide.specification.settling.high > sure.specification.settling.high
    assert any("unreliable identification" in words for words in wide.warnings)
    # A note or a warning is no reason to refuse.
    assert design(estimate(findings=[replace(DOUBT, severity="warning")]), LOOP).gains == sure.gains


def with_friction(quantity: Quantity) -> Estimate:
    one = estimate()
    names = tuple(n for n in one.names if n != "static_voltage")
    keep = [one.names.index(n) for n in names]
    known = {**one.combinations, "static_voltage": quantity}
    return replace(
        one, combinations=known, names=names, covariance=one.covariance[np.ix_(keep, keep)]
    )


@pytest.mark.parametrize(
    "quantity",
    [Quantity(0.0, 1.1e6), Quantity(None, status="unidentifiable"), Quantity(1.0, math.inf)],
)
def test_friction_that_may_be_anything_is_refused_with_what_to_record(quantity):
    with pytest.raises(DesignError, match="record the motor at two or more voltages"):
        design(with_friction(quantity), LOOP)


def test_friction_known_as_a_range_is_fed_forward_as_far_as_it_is_known():
    one = design(with_friction(Quantity(1.0, 0.5, (0.6, 2.4))), LOOP)
    assert one.gains.feedforward_static == 0.6
    assert any("between 0.6 and 2.4 V" in words for words in one.warnings)
    for friction in (0.6, 1.5, 2.4):
        true = {**TRUE, "static_voltage": friction}
        assert overshoot(one, true) <= one.specification.overshoot.high + 0.25
    # The reference leaves room for all that it may take.
    assert one.reference.max_velocity <= 25.0 * (0.92 * 12.0 - 2.4)


def test_coarse_counts_cost_no_more_than_the_limits_ask_for():
    """Of PI and PID gains of a dense grid within margins and control noise none is far better."""
    from smp_motor_ident.tune.feedback import Feedback, spectral_radius
    from smp_motor_ident.tune.margins import batch_margins
    from smp_motor_ident.tune.motors import motors_of
    from smp_motor_ident.tune.plant import sample
    from smp_motor_ident.tune.problem import Problem

    loop = replace(LOOP, counts_per_revolution=48.0, noise_voltage=0.48)
    one = design(estimate(), loop, structure="pi")
    problem = Problem(sample(motors_of(estimate()), loop), loop)
    best = 0.0
    for p in np.geomspace(0.002, 0.3, 40):
        for i in np.geomspace(0.05, 10.0, 40):
            feedback = Feedback(float(p), float(i))
            if i > best and problem.control_noise(feedback) <= 0.48:
                omega, T = problem.omega, loop.sample_time
                gain = problem.response * feedback.response(omega, T)
                m, hump = batch_margins(gain[None], omega), np.abs(gain / (1 + gain)).max()
                good = m.phase[0] >= 60 and m.sensitivity[0] <= 1.4 and hump <= 1.25
                if good and spectral_radius(problem.plant, feedback)[0] < 1:
                    best = float(i)
    # The uncertainty of the motor, 1 %, is not in the grid.
    assert one.gains.i >= 0.85 * best


def test_command_refuses_an_unreliable_result_unless_it_is_accepted(tmp_path, capsys):
    source, output = tmp_path / "identification.json", tmp_path / "gains.yaml"
    source.write_text(json.dumps(identification_document({"": estimate(findings=[DOUBT])})))
    assert tune([str(source), "--output", str(output)]) == 1
    assert "a dead zone of 2 V" in capsys.readouterr().err
    assert not output.exists()
    assert tune([str(source), "--output", str(output), "--accept-unreliable"]) == 0
    assert "designed on an unreliable identification" in capsys.readouterr().out
    entry = json.loads(output.with_suffix(".json").read_text())["wheels"][""]
    assert entry["findings"][0]["code"] == "unreliable_identification"
    for name in ("overshoot", "settling", "phase_margin", "gain_margin", "sensitivity"):
        band = entry["specification"][name]
        assert band["low"] <= band["value"] <= band["high"]


@pytest.mark.parametrize("seed", range(6))
def test_any_inductance_at_any_rate_ends_in_stable_gains(seed):
    """The short version of ``benchmarks/random_designs.py``."""
    rng = np.random.default_rng(seed)
    electrical, rate = 10 ** rng.uniform(-5, -2), 20 * 250 ** rng.uniform()
    values = {
        "time_constant": 0.03 + electrical,
        "time_constant_product": 0.03 * electrical,
        "averaging_window": rng.uniform(0, 3) / rate,
    }
    source = ("measured", "difference", "observer")[seed % 3]
    loop = replace(LOOP, sample_time=1 / rate, delay=None, speed_source=source)
    one = design(estimate(**values), loop, samples=60)
    assert one.margins.stable
    assert one.performance.overshoot < 5.0
    assert math.isfinite(one.specification.settling.value)


def test_noise_of_a_recorded_speed_limits_the_gains():
    """What is fed back shakes the voltage: by little where the design knows of it."""
    rng = np.random.default_rng(4)
    T, n, noise = 0.002, 6000, 6.0
    voltage = np.repeat(rng.uniform(-10.0, 10.0, n // 60), 60)
    speed = np.zeros(n)
    decay = math.exp(-T / MOTOR["time_constant"])
    for k in range(1, n):
        speed[k] = decay * speed[k - 1] + (1 - decay) * MOTOR["dc_gain"] * voltage[k]
    shown = speed + noise * rng.standard_normal(n)
    record = Record("m", T * np.arange(n), voltage, None, shown, None, None)
    found = identify(replace(record, hardware=Hardware(1.0, None, 0, 12.0)))
    assert found.speed_noise == pytest.approx(noise, rel=0.05)
    usual = parser().parse_args(["identification"])
    loop = tuning.loop_for(found, usual)
    assert loop.speed_noise == found.speed_noise
    # It was recorded as it is at each instant: an average would have been identified.
    assert loop.difference_window == 0
    one, deaf = design(found, loop), design(found, replace(loop, speed_noise=0.0))
    heard = prepare(found, loop, "margin", {}).problem
    assert not heard.plant.window
    assert heard.control_noise(deaf.feedback) > 2 * loop.noise_limit
    assert one.performance.control_noise < 1.3 * loop.noise_limit
    assert one.specification.overshoot.high > deaf.specification.overshoot.high


def test_no_settling_is_stated_of_a_speed_that_is_rounded_by_more_than_its_band():
    """Within a step the loop sees nothing; as noise of that size it would average it."""
    step = 0.1 * 0.5 * 240.0
    smooth = replace(
        LOOP, counts_per_revolution=None, difference_window=0, speed_noise=0.289 * step
    )
    steps = replace(smooth, speed_step=step)
    seen, rounded = (design(estimate(), x, max_velocity=240.0) for x in (smooth, steps))
    assert rounded.gains == seen.gains and math.isnan(rounded.specification.settling.high)
    assert rounded.specification.overshoot.high > 3.0  # half of a step, less what sees it
    assert replace(steps, speed_noise=0.4 * step).rounding == 0.0  # of so much noise it is a mean
    fine = design(estimate(), replace(steps, speed_noise=0.03 * step, speed_step=0.1 * step))
    assert math.isfinite(fine.specification.settling.high)
    rng, T = np.random.default_rng(8), 0.01
    voltage = np.repeat(rng.uniform(-10.0, 10.0, 60), 30)
    speed = np.zeros(voltage.size)
    decay = math.exp(-T / MOTOR["time_constant"])
    for k in range(1, speed.size):
        speed[k] = decay * speed[k - 1] + (1 - decay) * MOTOR["dc_gain"] * voltage[k]
    shown = Record("m", T * np.arange(speed.size), voltage, velocity=step * np.round(speed / step))
    found = identify(replace(shown, hardware=Hardware(1.0, None, 0, 12.0)))
    assert tuning.loop_for(
        found, parser().parse_args(["identification"])
    ).rounding == pytest.approx(step)


def test_of_a_fast_loop_no_more_delay_is_asked_than_it_bears():
    """Two milliseconds are ten samples at 5 kHz: such an answer would be unstable."""
    fast = replace(LOOP, sample_time=2e-4, delay=2e-4, counts_per_revolution=None)
    quick = {"time_constant": 0.01, "time_constant_product": 0.0}
    one = design(estimate(0.002, **quick), fast, together=False)
    assert one.margins.delay < 2 * fast.delay_doubt
    assert one.reference.doubt == pytest.approx(0.5 * one.margins.delay)
    assert one.reference.transition_time < 0.1
