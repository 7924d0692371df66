# SPDX-License-Identifier: Apache-2.0
"""Accessibility of the pages, checked by axe-core in a browser."""

import numpy as np
import pytest
from browser import AXE, CHROMIUM, Browser, violations
from results import comparison, estimate, tuning_of_two

from smp_motor_ident.finding import Finding
from smp_motor_ident.report import commissioning, fleet
from smp_motor_ident.report.html import Report, render
from smp_motor_ident.result import Quantity, plain
from smp_motor_ident.tune.verification import Change, Reading

pytestmark = pytest.mark.skipif(not CHROMIUM, reason="no Chromium on this machine")


def report(monkeypatch: pytest.MonkeyPatch) -> str:
    """Return a report of two motors, one with a tuning page, and of a failed wheel."""
    one, other = estimate(), estimate("rear_right", current=False)
    return render(
        Report(
            {one.wheel: one, other.wheel: other}, {one.wheel: [comparison("estimation")]},
            {"rear_left": "voltage is constant; excite the motor"}, {"Command": "identify a b"},
            {one.wheel: tuning_of_two(monkeypatch, one)},
        )
    )  # fmt: skip


def fleet_page(_: pytest.MonkeyPatch) -> str:
    def gain(value: float) -> Quantity:
        return Quantity(value, 0.01, (value - 0.02, value + 0.02), "rad/s/V")

    rows = [
        fleet.Row(f"robot{k}", "front_left", f"bag{n}", n * fleet.DAY,
                  {"dc_gain": gain(25.0 + (0.3 * n if k == 3 else 0.02 * (n % 2)))}, 97.0, n == 9)
        for k in range(4) for n in range(10)
    ]  # fmt: skip
    rows.append(fleet.Row("robot9", "", "torn", 0.0, {}, failure="torn: is no bag"))
    return fleet.page(rows, fleet.drifts(rows))


def commissioning_page(_: pytest.MonkeyPatch) -> str:
    time = np.linspace(0.0, 1.0, 200)
    speed = 2.0 * (1 - np.exp(-time / 0.1))
    change = Change(
        "front_left", "forward", 2.0, time, speed + 0.01, speed - 0.1, speed, speed + 0.1,
        Reading(0.4, 1.0, 0.5), Reading(0.4, 1.0, 0.5), Reading(0.5, 2.0, 1.0), 0.03, 0.0,
    )  # fmt: skip
    steps = [("checks", "warning"), ("validation", "note"), ("verification", "refused")]
    findings = [
        {"step": step, **plain(Finding("code", severity, "what was seen", {}, "do this"))}
        for step, severity in steps
    ]
    names = [name for name, _ in commissioning.COLUMNS]
    document = {
        "wheels": ["front_left"], "date": "today", "passed": False, "verdict": "stopped: it did",
        "accepted": [], "findings": findings, "checks": {"front_left": dict.fromkeys(names, 1.0)},
        "amplitude": 6.0, "changes": [{
            "wheel": "front_left", "name": "forward", "setpoint": 2.0,
            "reading": {"settling": 0.4, "overshoot": 1.0, "error": None},
            "expected": {"settling": 0.4, "overshoot": 1.0, "error": 0.0},
            "allowed": {"settling": 0.5, "overshoot": 2.0, "error": 1.0}, "tolerance": 0.03,
        }],
    }  # fmt: skip
    rows = commissioning.results({"front_left": estimate()}, {}, document["changes"])
    return commissioning.render(document, [change], rows, "/**/front_left/wheel_pid:\n  p: 1.0\n")


@pytest.mark.skipif(AXE is None, reason="axe-core-python is not installed")
@pytest.mark.parametrize("made", [report, fleet_page, commissioning_page])
def test_pages_have_no_serious_accessibility_violation_at_any_width_or_theme(
    made, tmp_path, monkeypatch
):
    file = tmp_path / "page.html"
    file.write_text(made(monkeypatch))
    with Browser(tmp_path / "profile") as browser:
        for width, dark in ((1200, False), (390, True), (1200, True), (390, False)):
            browser.open(file, width, dark=dark)
            for show in (browser.drawn, browser.unfold):
                show()
                assert browser.value("document.documentElement.scrollWidth") <= width
                assert violations(browser) == []
        assert browser.complaints == []


def test_charts_work_with_mouse_and_keyboard(tmp_path, monkeypatch):
    file = tmp_path / "page.html"
    file.write_text(commissioning_page(monkeypatch))

    def press(browser: Browser, key: str, text: str = "") -> None:
        for kind in ("keyDown", "keyUp"):
            browser.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key, text=text,
                        windowsVirtualKeyCode={"Tab": 9}.get(key, 0))  # fmt: skip

    with Browser(tmp_path / "profile") as browser:
        browser.open(file, 1200)
        reached = []
        for _ in range(40):  # links, tables that scroll, buttons, charts
            press(browser, "Tab")
            reached.append(browser.value("document.activeElement.className"))
            if reached[-1] == "live":
                break
        assert "live" in reached
        # Keyboard users need a visible focus outline.
        assert browser.value("getComputedStyle(document.activeElement).outlineStyle") != "none"
        whole = browser.value("document.activeElement.dataset.shown")
        press(browser, "+", "+")
        browser.drawn()
        assert browser.value("document.activeElement.dataset.shown") != whole
        press(browser, "Escape")
        browser.drawn()
        assert browser.value("document.activeElement.dataset.shown") == whole
