"""What ends a test of a motor, on samples of a motor of this file's own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from smp_motor_control.excitation import SIGNALS
from smp_motor_control.wheel.protection import COPPER, Bounds, Protection, Resistance

R, L, K, J, B, FRICTION = 12.9, 0.31, 0.0110, 1.1e-6, 2.4e-6, 3.8e-4  # the first motor's, nearly
GEAR, COUNTS, STEP, NOISE = 65.5, 500, 0.01, 0.005
Array = NDArray[np.float64]
Sample = tuple[float, float, float, float, float]


def samples(
    signal: Callable[[Array], Array],
    seconds: float,
    warming: float = 0.0,
    held: bool = False,
    seed: int = 1,
) -> Iterator[tuple[Sample, float]]:
    """Yield samples as ``MotorState`` has them, and by how much the winding is warmer [K]."""
    time = np.arange(round(seconds / STEP)) * STEP
    volts = np.broadcast_to(signal(time), time.shape).tolist()
    noise = (NOISE * np.random.default_rng(seed).standard_normal(time.size)).tolist()
    i = w = angle = warmer = 0.0
    k, b = (0.0, 1e3) if held else (K, B)
    for n, at in enumerate(time.tolist()):
        if n % 50 == 0:  # the resistance is that of half a second
            warmer = warming * at
            a = np.zeros((5, 5))
            a[0] = [-R * (1 + COPPER * warmer) / L, -k / L, 0, 1 / L, 0]
            a[1] = [k / J, -b / J, 0, 0, -1 / J]
            a[2, 1] = 1.0
            rows = expm(a * STEP)[:3].tolist()
        drag = 0.0 if held else FRICTION * math.copysign(1.0, w or volts[n])
        i, w, angle = (
            p * i + q * w + r * angle + s * volts[n] + t * drag for p, q, r, s, t in rows
        )
        seen = math.floor(angle / (2 * math.pi) * COUNTS) / COUNTS * 2 * math.pi / GEAR
        yield (1e9 + at, volts[n], i + noise[n], w / GEAR, seen), warmer


def ended(protection: Protection, of: Iterator[tuple[Sample, float]]) -> tuple[str, float]:
    """Return why a test ended and how much warmer the winding was then."""
    warmer = 0.0
    for sample, warmer in of:
        if why := protection.add(*sample):
            return why, warmer
    return "", warmer


def signal(name: str) -> Callable[[Array], Array]:
    return SIGNALS[name](amplitude=6.0)


@pytest.mark.parametrize("name", ["sine", "square", "fourier", "steps", "chirp", "prbs", "ramp"])
def test_a_winding_that_heats_ends_the_test_and_one_that_does_not_never_does(name: str) -> None:
    warm = Protection(Bounds(rise=60.0))
    why, warmer = ended(warm, samples(signal(name), 60.0, warming=1.5))
    # Ten seconds for the memory of five and for the first that are taken for cold, and twice the
    # deviation of these, 3 % or 8 K.
    assert "its winding is" in why and 60.0 <= warmer <= 60.0 + 10.0 * 1.5 + 2 * 8.0
    assert ended(Protection(Bounds(rise=20.0)), samples(signal(name), 60.0))[0] == ""


def test_a_wheel_that_is_held_shows_its_heat_too() -> None:
    steady = Protection(Bounds(rise=60.0))
    why, warmer = ended(steady, samples(lambda t: 0 * t + 6.0, 60.0, 1.5, held=True))
    # Without motion R is known to a thousandth: the memory and the first seconds alone.
    assert "limit is 60 K" in why and 60.0 <= warmer <= 60.0 + 1.5 * 10.0


def test_a_constant_speed_shows_no_heat_and_raises_no_alarm() -> None:
    for seed in range(5):
        constant = samples(lambda t: 0 * t + 6.0, 30.0, seed=seed)
        assert ended(Protection(Bounds(rise=20.0)), constant)[0] == ""


def test_a_winding_is_compared_with_itself_before_an_earlier_signal_warmed_it() -> None:
    first = Protection(Bounds(rise=60.0))
    assert ended(first, samples(signal("sine"), 15.0))[0] == ""
    cold = first.winding.cold
    assert cold is not None and abs(cold.value - R) < 3 * max(cold.std, 0.01 * R)
    assert ended(Protection(Bounds(rise=20.0), cold), samples(signal("square"), 15.0))[0] == ""
    colder = Resistance(R / (1 + 60.0 * COPPER), 0.01)
    assert (
        "K warmer"
        in ended(Protection(Bounds(rise=20.0), colder), samples(signal("square"), 15.0))[0]
    )


@pytest.mark.parametrize(("what", "words"), [("speed", "turns at 20"), ("current", "is 20 A")])
def test_one_bad_sample_stops_nothing_and_a_twentieth_of_a_second_does(
    what: str, words: str
) -> None:
    def sample(k: int, value: float) -> Sample:
        speed, current = (value, 0.1) if what == "speed" else (1.0, value)
        return 1e9 + 0.01 * k, 6.0, current, speed, 0.0

    watched = Protection(Bounds(speed=10.0, current=10.0))
    once = [watched.add(*sample(k, 20.0 if k % 4 == 0 else 1.0)) for k in range(100)]
    assert not any(once)
    # Of either sign; six samples of 10 ms span 50 ms.
    said = [watched.add(*sample(100 + k, -20.0)) for k in range(7)]
    assert not any(said[:5]) and words in said[-1]


def test_without_limits_or_a_sensor_of_current_nothing_is_judged() -> None:
    for bounds in (Bounds(), Bounds(rise=1.0, current=1.0)):
        watched = Protection(bounds)
        blind = ((1e9 + STEP * k, 6.0, math.nan, 1e3, 5.0 * k) for k in range(4000))
        assert not any(watched.add(*sample) for sample in blind)
        assert watched.winding.cold is None
