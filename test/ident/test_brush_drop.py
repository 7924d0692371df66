"""A drop over brushes, told from friction by what brakes; sizes of which nothing is known."""

import numpy as np

from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation import driver_search
from smp_motor_ident.estimation.driver_profile import Profile
from smp_motor_ident.estimation.fit import Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.likelihood.first_order_lag import lagged
from smp_motor_ident.model.driver import DEAD_ZONE, DROP, EFFECTS
from smp_motor_ident.model.structures import FirstOrder
from smp_motor_ident.record import Record

FRICTION, GAIN, TAU = 1.1, 14.0, 0.025
LEVELS = (-9.0, -7.0, -5.0, -4.0, 4.0, 5.0, 7.0, 9.0)


def _steps(seed: int) -> list[Record]:
    """Return steps from rest; the gain of each is another by some percent, as of real motors."""
    rng = np.random.default_rng(seed)
    t = 1e-3 * np.arange(1200)
    records = []
    for level in LEVELS:
        way = np.sign(level)
        speed = GAIN * (1 + 0.03 * rng.standard_normal()) * (level - way * FRICTION)
        since = np.maximum(t - 0.3, 0.0)
        w = speed * (1 - np.exp(-since / TAU)) + 0.3 * rng.standard_normal(t.size)
        records.append(Record("motor", t, np.where(t > 0.3, level, 0.0), velocity=w))
    return records


def test_a_motor_that_never_brakes_runs_behind_a_drop_as_behind_a_dead_zone():
    """Taken as it was measured, a speed that a drop neither drives nor brakes stays what it is."""
    group = _steps(0)
    fit = initial_fit(prepare(group, False), FirstOrder(), Options())
    assert fit is not None
    explained = {
        effect.kind: Profile(group, "held", fit, Options(), effect).at(FRICTION)[0].deviance
        for effect in EFFECTS
        if effect.kind in (DROP, DEAD_ZONE)
    }
    assert abs(explained[DROP] - explained[DEAD_ZONE]) < 10.0


def test_a_size_of_which_nothing_is_known_is_tried_no_further_than_it_was_searched(monkeypatch):
    monkeypatch.setattr(driver_search, "sandwich_factor", lambda _: 1e9)
    rng = np.random.default_rng(2)
    command = np.repeat(rng.choice([-9.0, -5.0, -3.0, 3.0, 5.0, 9.0], 30), 40)
    speed = lagged(15.0 * np.clip(command, -6.0, 6.0), 12.0) + 0.3 * rng.standard_normal(1200)
    # An infinite size would be a RuntimeWarning.
    record = Record("motor", 0.005 * np.arange(1200), command, velocity=speed)
    found = estimate(record, "first_order")
    assert "clip_voltage" not in {n for n, q in found.combinations.items() if q.value is not None}
