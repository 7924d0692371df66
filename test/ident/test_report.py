# SPDX-License-Identifier: Apache-2.0
"""The report: a self-contained page with charts and text of the same numbers."""

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from results import PHYSICAL, comparison, correlation, estimate, tuning_of_two
from scipy.signal import lfilter

from smp_motor_ident.finding import Finding, format_figure
from smp_motor_ident.report import tuning_page, words
from smp_motor_ident.report.drawing import thin, ticks
from smp_motor_ident.report.figures import Comparison, frequency_charts, residual_charts
from smp_motor_ident.report.html import Report, render
from smp_motor_ident.report.summary import find_doubted
from smp_motor_ident.report.tuning_page import tuning_charts
from smp_motor_ident.result import ChainRecord, Correlation, Quantity, ResidualTests, Share
from smp_motor_ident.tune.curves import Curves


class Outside(HTMLParser):
    """Collect the external addresses and the identifiers of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.identifiers: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("src", "href", "xlink:href") and not (value or "").startswith("#"):
                self.addresses.append(value or "")
            if name == "id":
                self.identifiers.append(value or "")


@pytest.fixture(scope="module")
def page() -> str:
    wheels = {"front_left": estimate(), "rear_right": estimate("rear_right", current=False)}
    parts = [comparison("estimation"), comparison("validation")]
    failures = {"rear_left": "voltage is constant; excite the motor"}
    return render(Report(wheels, {"front_left": parts}, failures, {"Command": "identify a b"}))


def test_page_has_no_external_resources_and_unique_identifiers(page):
    outside = Outside()
    outside.feed(page)
    assert outside.addresses == []
    assert "@import" not in page
    assert not re.search(r"url\((?!#)", page)
    assert len(outside.identifiers) == len(set(outside.identifiers))


def test_user_supplied_names_are_escaped(page):
    assert "<script>alert" not in page
    assert "&lt;script&gt;" in page
    assert "<b>missed</b>" not in page


def test_page_states_failures_warnings_and_unidentifiable_parameters(page):
    assert "Voltage is constant; excite the motor." in page
    assert "look alike at 100 Hz" in page
    assert all(
        words.label_in_sentence(name) in page.split("Not identifiable")[1] for name in PHYSICAL
    )


@pytest.mark.parametrize(
    "named", [["time_constant"], ["dc_gain"], ["dc_gain", "time_constant"], []]
)
def test_unreliable_finding_marks_its_quantities_or_all_if_none_are_named(named):
    known = estimate(current=False)  # gain and time constant
    grave = Finding("code", "unreliable", "the data are poor", quantities=tuple(named))
    doubted = find_doubted(replace(known, findings=(*known.findings, grave)))
    # The most severe finding comes first.
    assert doubted == dict.fromkeys(named or ["dc_gain", "time_constant"], 1)


@pytest.mark.parametrize(
    ("quantity", "number", "between"),
    [
        (Quantity(0.0381133, 0.0016, (0.035, 0.0413), "s"), "38.1 ± 1.6 ms", "35.0 … 41.3"),
        (Quantity(864.0, 5700.0, (0.0, 12345.0), "V"), "900 ± 5700 V", "0 … 12300"),
        (Quantity(-2.7e-6, 6.6e-6, None, "V"), "(-2.7 ± 6.6)·10⁻⁶ V", "—"),
        (Quantity(25.5, 3e-13, None, "rad/s/V"), "25.5000000 ± 3·10⁻¹³ rad/s/V", "—"),
        (Quantity(12.9, status="fixed", unit="ohm"), "12.9 Ω", "—"),
        (Quantity(None, ci95=(0.0, math.inf), unit="s"), "0 … ∞ ms", "0 … ∞"),
        (Quantity(None, unit="s"), "—", "—"),
        (Quantity(0.31, 0.0996, (0.11, 0.5), "1"), "0.31 ± 0.10", "0.11 … 0.50"),
    ],
)
def test_value_is_rounded_by_its_standard_deviation(quantity, number, between):
    assert words.state(quantity) == number
    assert words.interval(quantity) == between


@pytest.mark.parametrize(
    ("size", "share", "told"),
    [(28.0, 1.874, "± 190 % (delay)"), (0.04, 0.0031, "± 0.31 % (delay)"),
     (150.0, None, "± 150 V (delay)"), (3.6e-5, None, "± 3.6·10⁻⁵ V (delay)")],
)  # fmt: skip
def test_systematic_errors_are_stated_with_two_digits_and_no_exponent(size, share, told):
    quantity = Quantity(14.9, 3.5, unit="V", systematic=(Share("delay", share, size),))
    assert words.systematic(quantity) == told


@pytest.mark.parametrize(
    ("value", "digits", "told"),
    [(3.6e-5, 3, "3.6·10⁻⁵"), (2e-6, 2, "2·10⁻⁶"), (1234.5, 3, "1234"), (-2.5e7, 3, "-2.5·10⁷"),
     (0.0456, 2, "0.046"), (0.0, 3, "0"), (-math.inf, 3, "∞")],
)  # fmt: skip
def test_figures_are_stated_without_an_exponent(value, digits, told):
    assert format_figure(value, digits) == told


def test_every_colour_of_the_charts_is_a_variable_of_the_page(page):
    charts = json.loads(re.findall(r'id="charts">(.*?)</script>', page, re.DOTALL)[0])
    used = set(re.findall(r"var\(--([a-z0-9-]+)\)", page))
    used |= {curve["color"] for chart in charts for curve in chart["curves"]}
    used |= {span[2] for chart in charts for span in chart["spans"]}
    defined = set(re.findall(r"--([a-z0-9-]+):", page))
    assert used <= defined


def test_each_chart_has_a_static_drawing_with_an_accessible_label(page):
    charts = json.loads(re.findall(r'id="charts">(.*?)</script>', page, re.DOTALL)[0])
    assert {chart["name"].split("-")[0] for chart in charts} >= {
        "speed", "residual", "voltage", "autocorrelation", "correlation", "gain", "phase",
    }  # fmt: skip
    assert len(re.findall(r'<svg class="static" role="img" [^>]*aria-label="[^"]', page)) == len(
        charts
    )


def test_browser_draws_and_zooms_every_chart_without_network_requests(page, tmp_path, browser):
    file = tmp_path / "report.html"
    file.write_text(page)
    for width, dark in ((1200, False), (390, True)):
        browser.open(file, width, dark=dark)
        # Folded charts are drawn when opened.
        figures = browser.value("document.querySelectorAll('figure.chart').length")
        assert 0 < browser.value("document.querySelectorAll('figure.ready').length") < figures
        browser.unfold()
        for inside in ("figure.ready", "figure canvas"):
            assert browser.value(f"document.querySelectorAll('{inside}').length") == figures
        assert browser.value("document.documentElement.scrollWidth") <= width
    # Speed, residual and voltage share their time: all three show the zoomed stretch.
    browser.value("document.querySelector('button[data-key=\"0\"]').click()")
    browser.value("document.querySelector('button[data-key=\"+\"]').click()")
    browser.drawn()
    shown = "[...document.querySelectorAll('.live')].slice(0, 3).map(e => e.dataset.shown)"
    first, *others = browser.value(shown)
    begin, end = map(float, first.split())
    assert others == [first, first]
    # Two stretches of 4000 samples at 5 ms; the page shows the middle half.
    assert (begin, end) == pytest.approx((10.0, 30.0), abs=0.1)
    assert browser.complaints == []
    assert set(browser.requests) == {file.as_uri()}


def test_tuning_sliders_select_precomputed_designs(tmp_path, monkeypatch, request):
    tuning = tuning_of_two(monkeypatch, estimate())
    soft, own = tuning.choices
    assert tuning.chosen == 1
    crossovers = [one.design.margins.crossover for one in (soft, own) if one.design]
    # A design at a bandwidth keeps it to the 5 % that the method allows itself.
    assert crossovers[0] == pytest.approx(0.5 * crossovers[1], rel=0.05)
    (held,) = tuning_page.page_data({"front_left": tuning})["wheels"].values()
    assert [f"p: {one.design.gains.p}" in shown["yaml"]
            for one, shown in zip((soft, own), held["choices"])
            if one.design] == [True, True]  # fmt: skip

    browser = request.getfixturevalue("browser")
    file = tmp_path / "report.html"
    file.write_text(render(Report({"front_left": estimate()}, tunings={"front_left": tuning})))
    browser.open(file, 390, dark=True)
    yaml = "document.getElementById('tuning-yaml').textContent"
    assert browser.value(yaml) == held["choices"][1]["yaml"]
    slider = "document.getElementById('tuning-bandwidth')"
    browser.value(f"{slider}.value = 0, {slider}.dispatchEvent(new Event('input'))")
    assert browser.value(yaml) == held["choices"][0]["yaml"]
    # A chart that is unfolded later shows the design of the slider.
    browser.value("document.querySelector('#tuning details').open = true")
    frame = "new Promise(done => setTimeout(done))"
    browser.ask("Runtime.evaluate", awaitPromise=True, expression=frame)
    assert "ready" in browser.value("document.getElementById('figure-tuning-gain').className")
    assert browser.value("document.documentElement.scrollWidth") <= 390
    assert browser.complaints == []
    assert set(browser.requests) == {file.as_uri()}


def test_residual_charts_show_the_values_of_the_residual_tests():
    tests = ResidualTests(False, True, correlation(0.5, 0.01), correlation(0.02, 0.01))
    own, cross = residual_charts("w", tests)
    assert own.lines == cross.lines == (-0.1, 0.0, 0.1)
    inside, outside = own.curves
    assert outside.y[0] == 0.5
    assert np.isnan(outside.y[1])
    assert inside.y[1] == 0.01
    assert np.isnan(cross.curves[1].y).all()  # independent: none outside


def test_the_autocorrelation_at_lag_zero_is_not_drawn_as_outside():
    every = Correlation(np.arange(3.0), np.array([1.0, 0.01, 0.02]), 0.1)
    tests = ResidualTests(autocorrelation=every, cross_correlation=every)
    own, cross = residual_charts("w", tests)
    assert own.x.tolist() == [1.0, 2.0] and own.summary.startswith("0 of 2 lags")
    assert cross.x.tolist() == [0.0, 1.0, 2.0]


def test_page_describes_the_model_by_its_chain_components():
    chain = ChainRecord(("friction", "dead_zone", "angle", "first_order"))
    known = replace(estimate(current=False), model="first_order", chain=chain)
    text = render(Report({known.wheel: known}))
    assert "<summary>Model: first order</summary>" in text
    words = "Coulomb friction, dead zone of the driver, angle (speed sensor), first order (motor)."
    assert words in text
    assert "candidate" not in text.split("<main>")[1].split("</main>")[0]
    bare = render(Report({known.wheel: replace(known, chain=ChainRecord())}))
    assert "Components of the chain" not in bare


def test_backticks_become_code_and_other_markup_is_escaped():
    said = Finding("scale", "warning", "see `gap` <b>", advice="state `current_accuracy`")
    known = replace(estimate(), findings=(said,))
    text = render(Report({known.wheel: known}))
    assert "See <code>gap</code> &lt;b&gt;." in text
    assert "State <code>current_accuracy</code>." in text


def test_frequency_response_from_data_matches_the_true_system():
    # A first-order lag sampled exactly, under noise: gain k/|1 + j w tau| of the held input.
    k, tau, step, n = 25.0, 0.1, 0.005, 16_384
    rng = np.random.default_rng(11)
    voltage = np.repeat(rng.uniform(-8, 8, n // 8), 8)
    decay = np.exp(-step / tau)
    speed = lfilter([k * (1 - decay)], [1, -decay], voltage)
    part = Comparison("validation", "b", np.arange(n) * step, voltage, speed, speed)
    gain, _ = frequency_charts("w", [part])
    z = np.exp(2j * np.pi * gain.x * step)
    truth = np.abs(k * (1 - decay) / (1 - decay / z))
    low = gain.x < 10
    # Leakage of a window of 20 s over a lag of 0.1 s is far below a percent.
    np.testing.assert_allclose(gain.curves[0].y[low], truth[low], rtol=0.01)


def test_frequency_response_ignores_a_pause_of_years():
    whole = comparison("estimation")
    later = np.arange(whole.time.size) >= 2000
    part = replace(whole, time=whole.time + 1.7e9 * later)  # 340 billion intervals
    gain, _ = frequency_charts("w", [part])
    usual, _ = frequency_charts("w", [whole])
    assert gain.x[-1] == pytest.approx(usual.x[-1], rel=0.2)


@pytest.mark.parametrize(("low", "high"), [(0.0, 46.0), (-3.2, 3.2), (1e-7, 2e-7)])
def test_axis_ticks_lie_within_the_range(low, high):
    found = ticks(low, high)
    assert 3 <= len(found) <= 12
    assert low <= found[0] < found[-1] <= high


def test_thinning_keeps_peaks_and_order():
    values = np.sin(np.arange(100_000) * 1e-3)
    values[54_321] = 9.0
    values[77] = np.nan
    index = thin(values, 1000)
    assert index.size <= 1004
    assert np.nanmax(values[index]) == 9.0
    assert np.all(np.diff(index) > 0)


def test_wheels_of_different_time_constants_share_the_axes_of_a_tuning():
    def curves(n: int, slow: float) -> Curves:
        band = np.ones((3, n))
        return Curves(
            time=np.linspace(0.0, slow, n), reference=np.ones(n), step=band, load=band,
            omega=np.geomspace(1 / slow, 100.0, n), gain=band, phase=band,
            sensitivity=band, noise=band,
        )  # fmt: skip

    charts = tuning_charts({"fast": curves(20, 0.2), "slow": curves(31, 0.5)}, 1.4)
    assert all(c.y.shape == chart.x.shape for chart in charts for c in chart.curves)
    step = charts[0]
    assert step.x[-1] == 500.0 and np.isnan(step.curves[0].y[-1]) and step.curves[1].y[-1] == 1.0
