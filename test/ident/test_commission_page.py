# SPDX-License-Identifier: Apache-2.0
"""Pages in a browser: the first view of a commissioning, widths, and accessibility by axe-core."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from browser import AXE, Browser, violations
from results import comparison, estimate, tuning_of_two

from smp_motor_control import WHEELS
from smp_motor_ident.cli.commissioning_log import CommissioningLog
from smp_motor_ident.commission.wheel_test import Figures
from smp_motor_ident.finding import Finding
from smp_motor_ident.report import commissioning, fleet
from smp_motor_ident.report.document import identification_document
from smp_motor_ident.report.html import Report, render
from smp_motor_ident.result import Quantity, Share, plain, to_json
from smp_motor_ident.tune.verification import Change, Reading

FIGURES = Figures(200.0, 0.001, 0, 0.0, 0.5941, 0.4508, 1.0, 1.0, 25.56, 0.4, 0.05, 5.0)
GAINS = dict(p=2.675, i=87.97, d=0.06112, feedforward_static=0.45, feedforward_velocity=2.564,
             feedforward_acceleration=0.1309)  # fmt: skip


def change(wheel: str, name: str, setpoint: float) -> Change:
    time = np.linspace(0.0, 0.9, 180)
    speed = setpoint * np.clip(time / 0.145, 0.0, 1.0)
    return Change(
        wheel, name, setpoint, time, speed, speed - 0.01, speed, speed + 0.01,
        Reading(0.149, 1.3, 0.02), Reading(0.144, 0.7, 0.0), Reading(0.16, 3.0, 2.4), 0.03, 0.0,
    )  # fmt: skip


@pytest.fixture
def passed(tmp_path: Path) -> Path:
    """Return a folder with a passed commissioning of four wheels, driven both ways."""
    estimates = {wheel: estimate(wheel) for wheel in WHEELS}
    shares = (Share("current_scale", 0.03, 0.39), Share("smoothed_current", 0.0043, 0.06),
              Share("low_passed_current", 0.0022, 0.03))  # fmt: skip
    for wheel, one in estimates.items():
        held = {n: replace(q, systematic=shares) for n, q in one.parameters.items()}
        estimates[wheel] = replace(one, parameters=held)
    (tmp_path / "identification").mkdir()
    text = to_json(identification_document(estimates))
    (tmp_path / "identification" / "identification.json").write_text(text)
    band = {"value": 0.145, "low": 0.145, "high": 0.15}
    entry = {"gains": GAINS, "specification": {"settling": band, "overshoot": band}}
    entry["settling"] = {"transition": 0.16}
    (tmp_path / "gains.json").write_text(json.dumps({"wheels": dict.fromkeys(WHEELS, entry)}))
    nodes = {f"/**/{wheel}/wheel_pid": {"ros__parameters": GAINS} for wheel in WHEELS}
    (tmp_path / "gains.yaml").write_text("# designed by tune\n" + yaml.safe_dump(nodes))
    made = CommissioningLog(tmp_path)
    made.begin(WHEELS, {})
    made.store_checks(dict.fromkeys(WHEELS, FIGURES), 6.0, 1.6)
    made.store_changes(
        [change(w, n, v) for w in WHEELS for n, v in (("forward", 1.2), ("reverse", -1.2))]
    )
    made.mark(identified=True, tuned=True)
    made.store_verdict(True, "The wheels drove as designed.")
    return tmp_path


def read_texts(browser: Browser, where: str) -> list[str]:
    """Return the texts of elements."""
    text = f"[...document.querySelectorAll({where!r})].map(e => e.innerText.trim())"
    found: list[str] = browser.value(text)
    return found


def test_page_shows_gains_then_yaml_then_verification_drive(passed, browser):
    browser.open(passed / "report.html", 1280)
    assert read_texts(browser, "main h2") == [
        "Motors and gains", "Parameters of wheel_pid", "Verification drive",
        "Checks of the wheels",
    ]  # fmt: skip
    assert read_texts(browser, ".verdict") == ["Passed. The wheels drove as designed."]
    # The numbers equal those of the JSON, with their standard deviations.
    rows = {row.split("\t")[0]: row.split("\t")[1:] for row in read_texts(browser, "#results tr")}
    assert rows["p V s/rad"] == ["2.675"] * 4 and rows["i V/rad"] == ["87.97"] * 4
    assert rows["DC gain rad/s/V"] == ["25.50 ± 0.10"] * 4
    # Systematic errors are listed separately and fit the page width.
    assert [" ".join(cell.split()) for cell in rows["Resistance Ω"]] == [
        "12.92 ± 0.13 ± 3 % (current scale), ± 0.43 % (current smoothing), "
        "± 0.22 % (current low-pass)"
    ] * 4
    assert rows["Settles, designed ms"] == ["145, at most 150"] * 4
    assert rows["Settles, measured ms"] == ["149"] * 4
    # The button copies the parameter file.
    (copied,) = read_texts(browser, "#gains pre")
    assert yaml.safe_load(copied) == yaml.safe_load((passed / "gains.yaml").read_text())
    # One chart per wheel shows the predicted and measured speed of both directions.
    charts: list[dict[str, Any]] = browser.value(
        "JSON.parse(document.getElementById('charts').textContent)"
    )
    assert [len(chart["curves"]) for chart in charts] == [4] * 4
    assert browser.complaints == []


@pytest.mark.parametrize("width", [1280, 1000, 720, 390])
def test_tables_fit_the_page_width_without_horizontal_scrolling(passed, browser, width):
    browser.open(passed / "report.html", width)
    assert browser.value("document.documentElement.scrollWidth") <= width
    browser.value("document.querySelector('details').open = true")
    ends = browser.value(
        "[...document.querySelectorAll('table.stack td')].map(e => "
        "[e.getBoundingClientRect().right, e.closest('section').getBoundingClientRect().right, "
        "e.scrollWidth - e.clientWidth])"
    )
    assert ends and all(cell <= panel and over <= 0 for cell, panel, over in ends)


def test_unverified_gains_are_not_reported_as_passed(passed, browser):
    made = CommissioningLog(passed)
    made.store_changes([])
    made.store_verdict(False, "stopped: a wheel settles late")
    browser.open(passed / "report.html", 1280)
    text = browser.value("document.body.innerText")
    assert "Not passed." in text and "These gains have not passed a verification drive." in text


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
    made, tmp_path, monkeypatch, browser
):
    file = tmp_path / "page.html"
    file.write_text(made(monkeypatch))
    for width, dark in ((1200, False), (390, True), (1200, True), (390, False)):
        browser.open(file, width, dark=dark)
        for show in (browser.drawn, browser.unfold):
            show()
            assert browser.value("document.documentElement.scrollWidth") <= width
            assert violations(browser) == []
    assert browser.complaints == []


def test_charts_work_with_mouse_and_keyboard(tmp_path, monkeypatch, browser):
    file = tmp_path / "page.html"
    file.write_text(commissioning_page(monkeypatch))

    def press(browser: Browser, key: str, text: str = "") -> None:
        for kind in ("keyDown", "keyUp"):
            browser.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key, text=text,
                        windowsVirtualKeyCode={"Tab": 9}.get(key, 0))  # fmt: skip

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
