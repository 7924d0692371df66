# SPDX-License-Identifier: Apache-2.0
"""Tables whose clock restarts are split into runs; rows out of order are sorted."""

from pathlib import Path

import numpy as np
import pytest
from recordings import assert_refused, codes, follow, read_one, write_table

from smp_motor_ident.bag import list_topics, read_records
from smp_motor_ident.bag.clock import split_into_runs
from smp_motor_ident.record import Record

MAP = ["voltage=u velocity=w time=t"]
STEP = 0.01


def run(n: int, seed: int, begin: float = 0.0, hold: int = 10) -> np.ndarray:
    """Return rows of time, voltage and speed of a motor, 20 rad/s/V and 0.1 s, with noise."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-6, 6, n // hold + 1), hold)[:n]
    noisy = follow(voltage) + rng.normal(0, 0.1, n)
    return np.stack([begin + STEP * np.arange(n), voltage, noisy], axis=1)


def write(path: Path, rows: np.ndarray, names: str = "tuw") -> Path:
    return write_table(path, **dict(zip(names, rows.T)))


def read(path: Path, rows: np.ndarray, mapping: list[str] = MAP) -> Record:
    return read_one(write(path, rows), mapping)


@pytest.mark.parametrize(
    "parts",
    [
        pytest.param([run(300, 1), run(300, 2)], id="two runs from zero"),
        pytest.param([run(300, k) for k in range(9)], id="nine runs from zero"),
        pytest.param([run(300, 1, 0.5), run(200, 2, 0.2), run(400, 3)], id="different start times"),
        pytest.param([run(300, 1), run(8, 2), run(300, 3)], id="with an aborted run"),
        pytest.param([run(300, 1), run(300, 2, 2.9)], id="clock set back by 0.1 s"),
        pytest.param([run(60, 1), run(60, 2)], id="short runs"),
    ],
)
def test_concatenated_runs_become_segments(tmp_path, parts):
    record = read(tmp_path / "log.csv", np.concatenate(parts))
    lengths = [len(part) for part in parts]
    assert record.starts == tuple(np.cumsum([0, *lengths])[:-1].tolist())
    np.testing.assert_allclose(record.velocity, np.concatenate(parts)[:, 2], atol=1e-6)
    found = [f for f in record.findings if f.code == "clock_set_back"]
    assert [f.evidence["times"] for f in found] == [len(parts) - 1]
    assert {"samples_reordered", "duplicate_samples"}.isdisjoint(codes(record))


@pytest.mark.parametrize("pause", [0.0, 60.0])
def test_hold_of_voltage_is_not_inferred_from_changes_between_runs(tmp_path, pause):
    """Voltage and speed both change at the first row of a run, without causal relation."""
    parts = [run(600, 6 + k, k * pause, hold=100) for k in range(3)]
    record = read(tmp_path / "log.csv", np.concatenate(parts))
    assert record.starts == (0, 600, 1200)
    assert "held_before" not in codes(record)


@pytest.mark.parametrize("slow", [60, 300])
def test_runs_may_have_different_sample_rates(tmp_path, slow):
    rows = np.concatenate([run(600, 1), run(slow, 2) * [2, 1, 1]])
    record = read(tmp_path / "log.csv", rows)
    assert record.starts == (0, 600)
    assert "samples_missing" not in codes(record)
    np.testing.assert_allclose(record.voltage[601:], rows[600:-1, 1], atol=1e-6)


def test_incomplete_last_row_of_run_is_removed(tmp_path):
    parts = run(200, 1), run(300, 2)
    counts = [np.floor(50 * np.cumsum(STEP * part[:, 2])) for part in parts]
    lines = [
        f"{t:.2f},{u:g},{n:.0f}" for part, c in zip(parts, counts) for (t, u, _), n in zip(part, c)
    ]
    lines[199] = lines[199].rpartition(",")[0]
    (tmp_path / "log.csv").write_text("\n".join(["t,u,n", *lines]))
    record = read_records(tmp_path / "log.csv", ["voltage=u count=n time=t"])["motor"]
    assert record.starts == (0, 199)
    np.testing.assert_array_equal(np.diff(record.count[199:]), np.diff(counts[1]))


@pytest.mark.parametrize("order", ["concatenated", "interleaved"])
@pytest.mark.parametrize(
    "column, names, motors",
    [
        ("motor_id", ("0", "1"), ("motor_0", "motor_1")),
        ("Wheel", ("L", "R"), ("L", "R")),
        ("joint name", ("front left", "rear left"), ("front_left", "rear_left")),
        ("wheel", ("0", "1"), ("motor",)),  # an ordinal number, or a speed
        ("motor", ("ON", "OFF"), ("motor",)),
        ("trial", ("a1", "a2"), ("motor",)),
    ],
)
def test_motors_are_separated_by_identifying_column(tmp_path, order, column, names, motors):
    parts = [run(300, 1), run(300, 2)]
    rows = [(row, name) for part, name in zip(parts, names) for row in part]
    if order == "interleaved":
        rows = [rows[k + n] for k in range(300) for n in (0, 300)]
    text = [f"t,{column},u,w", *(f"{t:g},{name},{u:.6f},{w:.6f}" for (t, u, w), name in rows)]
    (tmp_path / "log.csv").write_text("\n".join(text))
    records = read_records(tmp_path / "log.csv", MAP)
    assert tuple(records) == motors
    for name, part in zip(motors, parts):
        if len(motors) > 1:
            np.testing.assert_allclose(records[name].velocity, part[:, 2], atol=1e-6)
            assert "several_motors" in codes(records[name])


def test_gap_allowed_by_user_does_not_join_runs(tmp_path):
    rows = np.concatenate([run(300, 1), run(300, 2)])
    assert read(tmp_path / "log.csv", rows, [*MAP, "gap=30"]).starts == (0, 300)


def test_runs_with_slow_sampling_are_separated(tmp_path):
    rows = np.concatenate([run(50, 1), run(50, 2)])
    rows[:, 0] *= 50  # two samples per second
    assert read(tmp_path / "log.csv", rows).starts == (0, 50)


def move_row(rows: np.ndarray, row: int, to: int) -> np.ndarray:
    order = np.insert(np.delete(np.arange(len(rows)), row), to, row)
    return rows[order]


def shuffle_rows(rows: np.ndarray) -> np.ndarray:
    return np.random.default_rng(5).permutation(rows)


@pytest.mark.parametrize(
    "late",
    [
        pytest.param(lambda rows: move_row(rows, 20, 23), id="row late by 3 rows"),
        pytest.param(lambda rows: move_row(rows, 20, 250), id="row late by 230 rows"),
        pytest.param(lambda rows: move_row(rows, 250, 20), id="row early by 230 rows"),
        pytest.param(lambda rows: move_row(rows, 20, 299), id="row moved to the end"),
        pytest.param(
            lambda rows: np.concatenate([rows[:50], rows[80:120], rows[50:80], rows[120:]]),
            id="block flushed late",
        ),
        pytest.param(lambda rows: np.concatenate([rows[150:], rows[:150]]), id="halves swapped"),
        pytest.param(lambda rows: rows[::-1], id="reversed order"),
        pytest.param(shuffle_rows, id="shuffled"),
    ],
)
def test_rows_out_of_order_are_sorted(tmp_path, late):
    rows = run(300, 4)
    record = read(tmp_path / "log.csv", late(rows))
    np.testing.assert_allclose(record.velocity, rows[:, 2], atol=1e-6)
    assert record.starts == (0,)
    assert "samples_reordered" in codes(record)
    assert "clock_set_back" not in codes(record)


def test_duplicate_rows_are_not_a_separate_run(tmp_path):
    rows = run(300, 6)
    record = read(tmp_path / "log.csv", np.concatenate([rows[:200], rows[100:]]))
    np.testing.assert_allclose(record.velocity, rows[:, 2], atol=1e-6)
    assert "duplicate_samples" in codes(record)
    assert "clock_set_back" not in codes(record)


def test_alternating_blocks_of_two_signals_are_not_separate_runs():
    time = np.concatenate(
        [np.arange(50.0), np.arange(50.0), 50 + np.arange(50), 50 + np.arange(50)]
    )
    first = np.where(np.arange(200) // 50 % 2 == 0, 1.0, np.nan)
    second = np.where(np.isnan(first), 2.0, np.nan)
    assert split_into_runs(time, {"u": first, "w": second}) == [(0, 200)]


def test_clock_restart_is_found_despite_late_blocks_and_rows():
    """Each late block is compared only with rows since the last one, to bound the cost."""
    blocks = np.arange(20_000.0).reshape(-1, 20)
    late = blocks.reshape(-1, 2, 20)[:, ::-1].ravel()
    assert split_into_runs(late, {}) == [(0, late.size)]
    stray = np.arange(20_000.0)
    stray[1000::1000] -= 50
    twice = np.concatenate([late, stray, stray])
    assert split_into_runs(twice, {}) == [(0, 20_000), (20_000, 40_000), (40_000, 60_000)]


def test_tables_with_common_clock_are_split_at_the_same_restart(tmp_path):
    parts = [run(300, 1), run(300, 2)]
    rows = np.concatenate(parts)
    files = [
        write(tmp_path / "set.csv", np.concatenate([p[:, :2] for p in parts]), "tu"),
        write(tmp_path / "state.csv", rows[:, [0, 2]], "tw"),
    ]
    record = read_records(files, ["voltage=/set.u velocity=/state.w time=t"])["motor"]
    assert record.starts == (0, 300)
    np.testing.assert_allclose(record.velocity, rows[:, 2], atol=1e-6)
    np.testing.assert_allclose(record.voltage[301:], rows[300:-1, 1], atol=1e-6)


def test_tables_with_different_clock_restarts_are_refused(tmp_path):
    rows = np.concatenate([run(300, 1), run(300, 2)])
    files = [
        write(tmp_path / "set.csv", run(600, 3)[:, :2], "tu"),
        write(tmp_path / "state.csv", rows[:, [0, 2]], "tw"),
    ]
    assert_refused(
        r"0 times in /set, 1 times in /state.*files of its own",
        files,
        ["voltage=/set.u velocity=/state.w time=t"],
    )


def test_file_of_several_runs_is_joined_with_other_files(tmp_path):
    two, one = np.concatenate([run(300, 1), run(300, 2)]), run(200, 3)
    paths = [write(tmp_path / "a.csv", two), write(tmp_path / "b.csv", one)]
    record = read_records(paths, MAP)["motor"]
    assert record.starts == (0, 300, 600)


def test_voltage_is_proposed_for_table_of_several_runs(tmp_path):
    rows = np.concatenate([run(300, k) for k in range(4)])
    path = write(tmp_path / "log.csv", rows)
    assert list_topics(path)[0].suggestion == ["voltage=u", "velocity=w", "time=t"]
