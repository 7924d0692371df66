# SPDX-License-Identifier: Apache-2.0
"""Long recordings are reduced to evenly spread excerpts."""

import motors
import numpy as np

from smp_motor_ident.cli.identification import identify_wheel
from smp_motor_ident.estimate import estimate
from smp_motor_ident.limits import MAX_EXCERPT_ROWS
from smp_motor_ident.quality.excitation import STRETCH_COUNT, select_excerpts
from smp_motor_ident.record import Record

SIGMAS = 4.0  # one of four quantities passes them by chance in 4,000 records; the seed is fixed


def test_short_record_is_used_whole() -> None:
    record = motors.record(seconds=2.0)
    assert select_excerpts([record, record], 2 * len(record)) == [record, record]
    assert select_excerpts([]) == []


def test_excerpts_are_spread_evenly_over_a_long_record() -> None:
    whole = motors.record(seconds=20.0)
    parts = select_excerpts([whole], 4_000)
    assert [len(part) for part in parts] == STRETCH_COUNT * [500]
    begins = np.linspace(0, len(whole) - 500, STRETCH_COUNT).astype(int)
    for part, begin in zip(parts, begins, strict=True):
        assert np.array_equal(part.voltage, whole.voltage[begin : begin + 500])
    (found,) = parts[0].findings[len(whole.findings) :]
    assert found.code == "excerpt"
    assert found.evidence == {"rows": 12_000.0, "used": 4_000.0}


def test_excerpt_rows_are_allotted_by_length_and_short_records_kept_whole() -> None:
    whole = motors.record(seconds=20.0)
    parts = select_excerpts([whole, whole.slice(0, 6_000), whole.slice(0, 60)], 4_000)
    assert [len(part) for part in parts] == [*3 * [885], *3 * [442], 60]


def test_motor_is_identified_from_excerpts_of_a_long_record() -> None:
    found = estimate(select_excerpts([motors.record(seconds=20.0, current=False)], 4_000))
    names = ("dc_gain", "time_constant", "time_constant_product", "static_voltage")
    motors.check(found, motors.truth("rear_left", 0.3), names, sigmas=SIGMAS)


def test_identify_fits_and_shows_excerpts_of_a_long_record() -> None:
    rows = round(1.2 * MAX_EXCERPT_ROWS)
    rng = np.random.default_rng(0)
    time = 0.001 * np.arange(rows)
    voltage = np.repeat(rng.uniform(-6.0, 6.0, rows // 100), 100)
    speed = motors.first_order(voltage, 25.0, 0.06, 0.001)
    record = Record("motor", time, voltage, velocity=speed + rng.normal(0.0, 0.5, rows))
    outcome = identify_wheel([record], (), "auto", {}, lambda _: None)
    assert [f.code for f in outcome.estimate.findings].count("excerpt") == 1
    motors.check(outcome.estimate, {"dc_gain": 25.0}, sigmas=SIGMAS)
    assert len(outcome.comparisons) == STRETCH_COUNT
