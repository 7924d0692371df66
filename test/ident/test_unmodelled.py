"""What a recording tells about the response, frequency by frequency, with its confidence."""

from __future__ import annotations

import numpy as np
import pytest

from smp_motor_ident.diagnosis.unmodelled import relative_error
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record
from smp_motor_ident.report.document import identification_document, read_identification


def lines(rng, n=600, error=0.0, noise=1.0):
    """Independent lines of an output of 1 V/Hz, of its error, and of noise in that."""
    omega = np.linspace(1.0, 100.0, n)
    output = np.exp(2j * np.pi * rng.random(n))
    white = (rng.standard_normal(n) + 1j * rng.standard_normal(n)) / np.sqrt(2)
    return omega, error * output + noise * white, output


def test_circle_holds_the_error_as_often_as_it_says():
    # Independent lines tell more than those of a window: the circle then holds it more often.
    inside = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        true = 0.7 * np.exp(2j * np.pi * rng.random())
        found = relative_error(*lines(rng, error=true))
        radius = np.array(found.bound) - np.array(found.shown)
        inside += list(np.abs(np.array(found.shown) - 0.7) <= radius)
    assert np.mean(inside) > 0.95


def test_circle_of_windowed_noise_holds_nothing_as_often_as_it_says():
    # Noise alone under a Hann window, whose neighbouring lines hang together.
    inside, bands = 0, 0
    window = np.hanning(2002)[1:-1]
    for seed in range(200):
        rng = np.random.default_rng(seed)
        noise, output = (np.fft.rfft(window * rng.standard_normal(2000))[2:] for _ in range(2))
        found = relative_error(np.arange(2.0, 1001.0), noise, output)
        inside += sum(2 * s <= b for s, b in zip(found.shown, found.bound, strict=True))
        bands += len(found.shown)
    assert 0.93 < inside / bands < 0.985


def test_bound_grows_where_the_output_is_small():
    rng = np.random.default_rng(1)
    omega, error, output = lines(rng, noise=0.01)
    found = relative_error(omega, error, output / (1 + (omega / 10) ** 2))
    bound = np.array(found.bound)
    # A response that falls to 1/50 or less in the last band, of which 25 times the lines tell.
    assert bound[0] < 0.02
    assert bound[-1] > 5 * bound[0]


def record(seed: int, resonance: float | None) -> Record:
    """Speed of 20 rad/s/V, 50 ms; a resonance behind it; the exact response to held voltages."""
    rng, T, n, sub = np.random.default_rng(seed), 0.005, 6000, 20
    u = 6.0 * np.sign(rng.standard_normal(n // 6)).repeat(6)
    h, y, w, rate, shown = T / sub, 0.0, 0.0, 0.0, []
    for k in range(n):
        for _ in range(sub):
            w += h * (20.0 * u[k] - w) / 0.05
            if resonance is None:
                y = w
            else:  # semi-implicit Euler keeps a lightly damped oscillation as it is
                rate += h * (resonance**2 * (w - y) - 0.1 * resonance * rate)
                y += h * rate
        shown.append(y)
    speed = np.concatenate([[0.0], shown]) + 0.3 * rng.standard_normal(n + 1)
    voltage = np.concatenate([[0.0], u])
    return Record("motor", np.arange(n + 1) * T, voltage, velocity=speed, source="made")


@pytest.fixture(scope="module")
def plain():
    return estimate(record(1, None))


def test_complete_model_is_known_and_nothing_is_shown(plain):
    error = plain.residuals.model_error
    frequency, shown, bound = map(np.array, (error.frequency, error.shown, error.bound))
    slow = frequency < 100.0
    assert bound[slow].max() < 0.2
    assert np.mean(shown[slow] > bound[slow] / 2) < 0.3


def test_resonance_that_the_voltage_excites_is_shown():
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
