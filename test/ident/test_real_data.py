# SPDX-License-Identifier: Apache-2.0
"""Real motors' recordings, as published (see their README for source and licence)."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate

DATA = Path(__file__).parents[3] / "shared" / "data"
pytestmark = pytest.mark.skipif(not DATA.exists(), reason="recordings are not at hand")


def prbs(day: str) -> Record:
    table = np.genfromtxt(DATA / f"prbs_gearmotor/prbs_{day}.csv", delimiter=",", names=True)
    return Record("motor", table["t"], table["u"], velocity=np.radians(table["y"]), source=day)


@cache
def estimate_day(day: str, kept: str = "") -> Estimate:
    return estimate(prbs(day), validation=[prbs(kept)] if kept else None)


def step(path: Path) -> Record:
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    volts = table[:, 2] / 5319 * 12.0
    speed = table[:, 1] * 2 * np.pi / 60
    return Record("motor", table[:, 0] * 1e-3, volts, velocity=speed, source=path.name)


EACH_OTHER = (("2026-08-14", "2026-08-18"), ("2026-08-18", "2026-08-14"))
OTHERS = (("2026-08-11",), ("2026-08-15",), ("2026-08-17",))


@pytest.mark.parametrize(("fitted", "kept"), EACH_OTHER)
def test_prbs_of_one_day_explains_the_other_day(fitted, kept):
    result = estimate_day(fitted, kept)
    # The owner's static curve; 3 % and the range of tau are from the data's README.
    assert np.degrees(result.value("dc_gain")) == pytest.approx(159.9, rel=0.03)
    assert 0.030 < result.value("time_constant") < 0.042
    assert result.fit_percent.validation > 94
    # The speed is a difference of counts over one sample, so the window is one sample.
    assert result.value("averaging_window") == pytest.approx(0.020, abs=0.002)


def test_scatter_over_five_days_is_within_the_stated_uncertainty():
    estimates = [estimate_day(*days) for days in (*EACH_OTHER, *OTHERS)]
    found = [one.combinations for one in estimates]
    for name in ("dc_gain", "time_constant", "static_voltage"):
        # The load differs from day to day, which one recording cannot show.
        value, std = (
            np.array([getattr(f[name], a) for f in found]) for a in ("value", "total_std")
        )
        mean = np.average(value, weights=std**-2)
        assert np.sum(np.square((value - mean) / std)) / 4 < 1.5**2, name


def test_joint_fit_of_five_steps_separates_speed_averaging_from_delay():
    result = estimate([step(p) for p in sorted((DATA / "step_gearmotor").glob("*.csv"))[::2]])
    assert result.fit_percent.estimation > 93
    assert result.fit_percent.validation > 93
    # The log's speed is a position difference over 32 samples of 1 ms.
    assert result.value("averaging_window") == pytest.approx(0.032, abs=0.004)
    assert result.value("delay") < 0.004
    assert any(f.code == "averaged_speed" for f in result.findings)


def test_friction_from_ten_steps_agrees_with_their_steady_speeds():
    result = estimate([step(p) for p in sorted((DATA / "step_gearmotor").glob("*.csv"))])
    lag = result.combinations["time_constant"]
    assert abs(lag.value - 0.0265) < 2 * lag.total_std
    # Lines through the five steady speeds of each way: 13.9 and 14.5 rad/s/V, 1.07 and 1.15 V.
    for name, known in (("dc_gain", 14.2), ("static_voltage", 1.11)):
        q = result.combinations[name]
        # The two directions differ by 4 and 7 %.
        assert q.value == pytest.approx(known, rel=0.1) and abs(q.value - known) < 2 * q.std
