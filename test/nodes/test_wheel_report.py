# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of wheel_pid, and evaluation of a wheel test, without a process."""

import math
from types import SimpleNamespace

import pytest

from smp_motor_control.nodes import runtime, wheel_pid
from smp_motor_control.nodes.wheel_test import Row, WheelRecording
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.controller import WheelController, WheelSettings
from smp_motor_control.wheel.loop import LoopSettings


@pytest.fixture
def make_report(monkeypatch):
    """Return the log and the assessment of a wheel with these gains."""

    def ask(gains, put=lambda wheel: None):
        assessments, log = [], []
        diagnostics = lambda node, assess, joint: (  # noqa: E731
            assessments.append(assess) or SimpleNamespace(due=False, publish=lambda: None)
        )
        monkeypatch.setattr(runtime, "Diagnostics", diagnostics)
        node = SimpleNamespace(get_logger=lambda: SimpleNamespace(warning=log.append))
        wheel = WheelController(WheelSettings(loop=LoopSettings(gains=gains)))
        wheel_pid.WheelReport(node, wheel, "left_wheel_joint")
        put(wheel)
        level, message, _ = assessments[0]()
        return log, level, message

    return ask


def feed(wheel: WheelController, now: float, velocity: float = 0.0, count: int = 0) -> None:
    state = SimpleNamespace(voltage=0.0, current=0.0, velocity=velocity, encoder_count=count)
    wheel.take_feedback(state, round(1e9 * now), round(1e9 * now), now)


def test_default_gains_are_reported_in_log_and_diagnostics(make_report):
    log, level, message = make_report(PidGains())
    assert log == [wheel_pid.UNTUNED_TEXT]
    assert wheel_pid.UNTUNED_TEXT in message
    assert level == runtime.OK  # no warning while the wheel is at rest


def test_configured_gains_are_not_reported(make_report):
    log, _, message = make_report(PidGains(p=2.0, i=30.0))
    assert log == []
    assert "gains" not in message
    assert "defaults" not in message


def test_feedback_slower_than_time_out_is_reported_with_both_times(make_report):
    def feed_slowly(wheel: WheelController) -> None:
        wheel.activate(100.0)
        for now in (100.25, 100.5, 100.75, 101.0):
            wheel.tick(now)
            feed(wheel, now)

    _, level, message = make_report(PidGains(p=2.0), feed_slowly)
    assert level == runtime.ERROR
    assert "came 0.25 s after the previous one, and feedback_timeout is 0.2 s" in message
    _, _, message = make_report(
        PidGains(p=2.0), lambda wheel: wheel.activate(0.0) or wheel.tick(9.0)
    )
    assert message.startswith("no feedback: 0 V") and "feedback_timeout" not in message


def test_oscillation_is_reported_with_advice(make_report):
    def swing(wheel: WheelController) -> None:
        wheel.activate(100.0)
        for k in range(1, 401):
            now = 100.0 + 0.02 * k
            wheel.take_setpoint(1.5, now)
            feed(wheel, now, 1.5 + 0.9 * math.sin(40.0 * 0.02 * k), k)

    _, level, message = make_report(PidGains(p=2.0), swing)
    assert level == runtime.WARN
    assert "oscillates by 0.88 rad/s around 1.5 rad/s at 6.3 Hz" in message
    assert "feedback at 50 Hz; halve p, i and d, or design them with tune --rate 50" in message


def recording(position) -> WheelRecording:
    """Return 8 s of a wheel at 2 rad/s whose driver reports ``position(angle)``."""
    rows = [Row(1e4 + t, 0.0, 3.0, 3.0, 2.0, position(2.0 * t), 0.0, 1.0)
            for t in (0.01 * k for k in range(800))]  # fmt: skip
    return WheelRecording(rows)


@pytest.mark.parametrize(
    ("position", "words"),
    [
        (lambda angle: angle, ""),
        (lambda angle: math.nan, ""),
        (lambda angle: 0.0, "never changes"),
        (lambda angle: angle % (2 * math.pi), "wraps"),
        (lambda angle: math.remainder(angle, 2 * math.pi), "wraps"),
        (lambda angle: angle if angle < 9.0 else angle - 9.0, "jumped"),
    ],
)
def test_position_unusable_for_odometry_is_reported(position, words):
    said = recording(position).position_problem()
    assert words in said and bool(words) is bool(said)


def test_empty_recording_has_no_position_problem():
    assert WheelRecording().position_problem() == ""
