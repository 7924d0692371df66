# SPDX-License-Identifier: Apache-2.0
"""Layout of the report: its length, its order and its first view."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from browser import Browser
from results import comparison, estimate

from smp_motor_ident.finding import Finding
from smp_motor_ident.report.figures import Comparison
from smp_motor_ident.report.html import Report, render
from smp_motor_ident.result import Estimate, Quantity, Share

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
LONG = "the voltage has one size, 3 V: " + ", ".join(["a driver that looks like another motor"] * 5)
SHARES = (("current_scale", 0.03), ("smoothed_current", 0.0043), ("low_passed_current", 0.0022))


def make_full_result(wheel: str) -> Estimate:
    """Return a result that fills a card: many findings, a range, systematic errors."""
    known = estimate(wheel)
    told = dict(known.combinations)
    told["time_constant"] = Quantity(None, ci95=(0.0, 0.0525), unit="s", status="unidentifiable")
    told["time_constant_product"] = Quantity(6e-4, 3e-5, (5.4e-4, 6.6e-4), "s^2")
    told["static_voltage"] = Quantity(0.3, 0.04, (0.22, 0.38), "V")
    told["delay"] = Quantity(0.0083, 0.0012, (0.006, 0.0105), "s")
    physical = {
        n: replace(q, systematic=tuple(Share(c, s, s * (q.value or 0.0)) for c, s in SHARES))
        for n, q in known.parameters.items()
    }
    warnings = [Finding(f"w{k}", "warning", f"{k}: {LONG}", advice=LONG) for k in range(4)]
    notes = [Finding(f"n{k}", "note", f"{k}: {LONG}") for k in range(3)]
    grave = Finding("lag_unknown", "unreliable", "the data do not tell it", advice=LONG,
                    quantities=("time_constant",))  # fmt: skip
    return replace(
        known, combinations=told, parameters=physical, findings=(*notes, *warnings, grave)
    )


def drive() -> list[Comparison]:
    """Return 40 s under a square-wave voltage, with the last third held out."""
    return [comparison("estimation", 27.0), comparison("validation", 13.0)]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    report = Report(
        {wheel: make_full_result(wheel) for wheel in WHEELS},
        {wheel: drive() for wheel in WHEELS},
        provenance={"Recordings": "monday", "Command": "identify monday"},
        folder="my results",
    )
    path.write_text(render(report))
    return path


def find_tops(browser: Browser, *selectors: str) -> list[float]:
    """Return where the first element of each selector begins, from the top of the page."""
    at = "document.querySelector({!r}).getBoundingClientRect().top + scrollY"
    return [browser.value(at.format(selector)) for selector in selectors]


@pytest.mark.parametrize(("width", "highest"), [(1280, 5000), (720, 12_000), (390, 12_000)])
@pytest.mark.parametrize("dark", [False, True])
def test_report_of_four_wheels_with_many_findings_stays_short(browser, file, width, highest, dark):
    browser.open(file, width, dark=dark)
    # A phone of 390 px shows a third of 1280 px, so the limit of 5,000 is scaled.
    assert browser.value("document.documentElement.scrollHeight") <= highest
    for _ in range(2):  # folded, then unfolded
        assert browser.value("document.documentElement.scrollWidth") <= width
        assert browser.value(
            "[...document.querySelectorAll('main table')].every(t => t.closest('.scroll') ||"
            " !t.checkVisibility() || t.scrollWidth <= t.parentElement.clientWidth + 1)"
        )
        browser.value("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    assert browser.complaints == []


def test_wheel_card_shows_values_chart_gains_and_findings_in_order(browser, file):
    browser.open(file, 390)
    order = find_tops(
        browser, "h1", "#side-by-side", "#front_left h2", "#front_left .values",
        "#front_left .chart", "#front_left .gains", "#front_left .findings",
        "#front_left details", "#front_right", "#reading",
    )  # fmt: skip
    assert order == sorted(order)
    every = "[...document.querySelectorAll('#front_left .findings li')]"
    seen = f"{every}.filter(e => !e.closest('details'))"
    tags = browser.value(f"{seen}.map(e => e.querySelector('.tag').textContent)")
    assert tags == ["unreliable 1", "warning 2", "warning 3"]
    assert browser.value("document.querySelectorAll('details[open]').length") == 0
    folded = "document.querySelectorAll('#front_left details .findings li').length"
    assert browser.value(folded) == 5


def row(browser: Browser, name: str) -> list[str]:
    """Return the cells of a quantity in the first card."""
    cells: list[str] = browser.value(
        "[...document.querySelectorAll('#front_left .values tr')].map(r => [...r.children]"
        f".map(c => c.textContent)).find(r => r[0].startsWith({name!r}))"
    )
    return cells


def test_the_card_names_unreliable_values_and_systematic_errors(browser, file):
    browser.open(file, 1280)
    verdict = browser.value("document.querySelector('#front_left .verdict').textContent")
    assert verdict == "Unreliable: time constant"
    # An unknown value has its range; a known one is rounded by its standard deviation.
    assert row(browser, "Time constant") == [
        "Time constant τ", "0 … 52.5 ms", "not identifiableunreliable, see 1",
    ]  # fmt: skip
    assert row(browser, "DC gain") == ["DC gain k", "25.50 ± 0.10 rad/s/V", ""]
    assert row(browser, "Lag product")[0] == "Lag product τ₁τ₂"
    shares = "± 3 % (current scale), ± 0.43 % (current smoothing), ± 0.22 % (current low-pass)"
    assert row(browser, "Resistance")[1:] == ["12.92 ± 0.13 Ω", shares]
    fit = browser.value("document.querySelector('#front_left .fit').textContent")
    assert "96.8 % on held-out data" in fit
    gains = browser.value("document.querySelector('#front_left .gains').textContent")
    assert "tune 'my results' --output gains.yaml --accept-unreliable" in gains


def test_intervals_of_all_wheels_are_drawn_on_a_common_axis(browser, file):
    browser.open(file, 1280)
    compared: list[dict[str, Any]] = browser.value(
        "[...document.querySelectorAll('.compared')].map(f => ({name: f.querySelector('h3')"
        ".textContent, ticks: [...f.querySelectorAll('.axis text')].map(t => t.textContent),"
        " wide: [...f.querySelectorAll('line:not(.grid)')].map(l => l.getBoundingClientRect()"
        ".width)}))"
    )
    named = {one["name"]: one for one in compared}
    # A quantity known only as a range is not compared.
    assert "Time constant" not in named
    for one in compared:
        assert len(one["ticks"]) >= 2
        assert len(one["wide"]) == 2 * len(WHEELS)  # random, and with systematic uncertainty
        assert min(one["wide"]) > 10  # px
    random, total = named["Resistance"]["wide"][1], named["Resistance"]["wide"][0]
    # 2 % of scatter at 95 %, 3 % of one deviation of scale and 0.5 % of the sensor's filter:
    # sqrt(2^2 + (1.96 * 3)^2 + (1.96 * 0.48)^2) of 2.
    assert total / random == pytest.approx(3.14, rel=0.02)


def test_chart_opens_at_single_responses_and_zooms_out(browser, tmp_path):
    known = estimate()
    path = tmp_path / "report.html"
    path.write_text(render(Report({known.wheel: known}, {known.wheel: drive()})))
    browser.open(path, 1280)
    shown = "document.querySelector('.live').dataset.shown"
    begin, end = map(float, browser.value(shown).split())
    # Eighty lags of 40 ms of the held-out data
    assert end - begin == pytest.approx(3.2, abs=0.1)
    assert begin > 26.9 and end <= 40.0
    browser.value("document.querySelector('button[data-key=\"0\"]').click()")
    browser.drawn()
    begin, end = map(float, browser.value(shown).split())
    assert (begin, end) == pytest.approx((0.0, 40.0), abs=0.1)
