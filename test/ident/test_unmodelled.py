# SPDX-License-Identifier: Apache-2.0
"""Model error of the response by frequency, with its confidence region."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from smp_motor_ident.estimate import estimate
from smp_motor_ident.infer.residuals import compute_relative_error
from smp_motor_ident.record import Record
from smp_motor_ident.report.document import identification_document, read_identification


def draw_lines(rng, n=600, error=0.0, noise=1.0):
    """Return spectral lines: frequency, error with noise, and output of unit magnitude."""
    omega = np.linspace(1.0, 100.0, n)
    output = np.exp(2j * np.pi * rng.random(n))
    white = (rng.standard_normal(n) + 1j * rng.standard_normal(n)) / np.sqrt(2)
    return omega, error * output + noise * white, output


def test_confidence_circle_covers_the_error_at_its_stated_level():
    # Independent lines carry more information than windowed ones, so the coverage is higher.
    inside = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        true = 0.7 * np.exp(2j * np.pi * rng.random())
        found = compute_relative_error(*draw_lines(rng, error=true))
        radius = np.array(found.bound) - np.array(found.shown)
        inside += list(np.abs(np.array(found.shown) - 0.7) <= radius)
    assert np.mean(inside) > 0.95


def test_confidence_circle_of_windowed_noise_covers_zero_at_its_stated_level():
    # Noise alone under a Hann window, whose neighbouring lines are correlated.
    inside, bands = 0, 0
    window = np.hanning(2002)[1:-1]
    for seed in range(200):
        rng = np.random.default_rng(seed)
        noise, output = (np.fft.rfft(window * rng.standard_normal(2000))[2:] for _ in range(2))
        found = compute_relative_error(np.arange(2.0, 1001.0), noise, output)
        inside += sum(2 * s <= b for s, b in zip(found.shown, found.bound, strict=True))
        bands += len(found.shown)
    assert 0.93 < inside / bands < 0.985


def test_bound_grows_where_the_output_is_small():
    rng = np.random.default_rng(1)
    omega, error, output = draw_lines(rng, noise=0.01)
    found = compute_relative_error(omega, error, output / (1 + (omega / 10) ** 2))
    bound = np.array(found.bound)
    # A response that falls to 1/50 or less in the last band, with 25 times the lines.
    assert bound[0] < 0.02
    assert bound[-1] > 5 * bound[0]


def test_resonance_narrower_than_its_band_is_detected_at_its_peak():
    # Its phase turns within the band, and its flanks lie on both sides of it.
    missed, found = 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        omega, error, output = draw_lines(rng, n=1200, noise=1.5)
        error += 3.0 * 5j * omega / (50.0**2 - omega**2 + 5j * omega) * output
        shown = compute_relative_error(omega, error, output)
        k = int(np.argmin(np.abs(np.log(np.array(shown.frequency) / 50.0))))
        # Three, less the loss at half of the distance to the next tested resonance.
        assert shown.bound[k] > 2.4
        found += 2 * shown.shown[k] > shown.bound[k] + 1
        missed += shown.bound[k] < 3.0
    assert found > 36
    assert missed < 4


def test_model_error_is_judged_by_the_least_excited_output():
    rng = np.random.default_rng(3)
    omega, error, output = draw_lines(rng, noise=0.1)
    faint = output / (1 + (omega / 10) ** 2)
    alone, both = (
        compute_relative_error(omega, error, x) for x in (faint, np.array([output, faint]))
    )
    assert both == alone
    # An error beyond the response itself counts, whatever moved the motor.
    _, _, other = draw_lines(rng)
    both = compute_relative_error(omega, error + 3.0 * output, np.array([output, 1e-2 * other]))
    assert both.shown == pytest.approx([3.0] * len(both.shown), rel=0.05)


def simulate_two_inertias(seed: int) -> tuple[Record, Callable[[np.ndarray], np.ndarray]]:
    """Return the record of a spring-coupled load with dry friction, and its response."""
    rng, T, n, sub = np.random.default_rng(seed), 0.002, 5000, 20
    gain, tau, ring, damping, share = 20.0, 0.07, 85.0, 0.05, 0.6
    spring, loss = (x * share * (1 - share) for x in (ring**2, 2 * damping * ring))
    u = 8.0 * 2 / np.pi * np.arcsin(np.sin(4.3 * T * np.arange(n)))
    h, w, load, twist, shown = T / sub, 0.0, 0.0, 0.0, []
    for k in range(n):
        for _ in range(sub):
            link = spring * twist + loss * (w - load)
            friction = 1.0 * gain / tau * np.tanh(load / 0.02)
            w += h / share * ((gain * u[k] - w) / tau - link)
            load += h / (1 - share) * (link - friction)
            twist += h * (w - load)
        shown.append(load)
    speed = np.concatenate([[0.0], shown]) + 0.5 * rng.standard_normal(n + 1)
    made = Record("motor", np.arange(n + 1) * T, np.concatenate([[0.0], u]), velocity=speed,
                  source="made")  # fmt: skip

    def response(omega: np.ndarray) -> np.ndarray:
        s = 1j * omega
        link = spring / s + loss
        carried = link / ((1 - share) * s + link)
        return gain / (tau * (share * s + (1 - share) * s * carried) + 1) * carried

    return made, response


def test_friction_kinks_under_ramps_do_not_count_as_excitation():
    made, response = simulate_two_inertias(4)
    one = estimate(made)
    error, (gain, tau) = one.residuals.model_error, map(one.value, ("dc_gain", "time_constant"))
    frequency, bound = np.array(error.frequency), np.array(error.bound)
    s = 1j * frequency
    lag = one.value("time_constant_product") or 0.0
    model = gain * np.exp(-s * (one.value("delay") or 0.0)) / (lag * s**2 + tau * s + 1)
    true = np.abs(response(frequency) / model - 1)
    assert true.max() > 2
    # Of some ten bands in which anything is known one may be missed at a level of 95 %.
    assert np.sum(bound < true) <= 1
    assert bound[frequency > 150].min() > 1


def record(seed: int, resonance: float | None) -> Record:
    """Return a motor of 20 rad/s/V and 50 ms, optionally with a resonance, under held voltage."""
    rng, T, n = np.random.default_rng(seed), 0.005, 6000
    u = 6.0 * np.sign(rng.standard_normal(n // 6)).repeat(6)
    num, den = [20.0], [0.05, 1.0]
    if resonance is not None:
        num = [20.0 * resonance**2]
        den = np.polymul(den, [1.0, 0.1 * resonance, resonance**2])
    b, a, _ = cont2discrete((num, den), T)
    speed = lfilter(b.ravel(), a, np.append(u, 0.0)) + 0.3 * rng.standard_normal(n + 1)
    voltage = np.concatenate([[0.0], u])
    return Record("motor", np.arange(n + 1) * T, voltage, velocity=speed, source="made")


@pytest.fixture(scope="module")
def plain():
    return estimate(record(1, None))


def test_complete_model_has_no_significant_model_error(plain):
    error = plain.residuals.model_error
    frequency, shown, bound = map(np.array, (error.frequency, error.shown, error.bound))
    slow = frequency < 100.0
    assert bound[slow].max() < 0.2
    assert np.mean(shown[slow] > bound[slow] / 2) < 0.3


def test_excited_resonance_is_a_significant_model_error():
    error = estimate(record(2, 150.0), "first_order").residuals.model_error
    frequency, shown, bound = map(np.array, (error.frequency, error.shown, error.bound))
    near = np.argmin(np.abs(np.log(frequency / 150.0)))
    assert 2 * shown[near] - bound[near] > 1.0


def test_model_error_is_written_and_read(plain, tmp_path):
    import json

    path = tmp_path / "identification.json"
    path.write_text(json.dumps(identification_document({"motor": plain})))
    (again,) = read_identification(path).values()
    assert again.residuals.model_error == plain.residuals.model_error
