# SPDX-License-Identifier: Apache-2.0
"""Tables in the formats of common loggers, each with the same 300 samples."""

from collections.abc import Callable

import numpy as np
import pytest
from recordings import assert_refused, codes, read_one, read_table, write_table

from smp_motor_ident.bag import read_records

N = 300
T = 0.01 * np.arange(N)
RNG = np.random.default_rng(1)
U = np.round(RNG.uniform(-6, 6, N), 4)
Y = np.round(np.cumsum(RNG.normal(0, 1, N)), 4)
MAP = "voltage=u velocity=y time=t"
START = np.datetime64("2026-06-01T16:16:31", "us")
ISO = [str(START + round(1e6 * t)) for t in T]


def rows(separator: str = ",", time: Callable[[int], str] = lambda k: f"{T[k]:.2f}") -> list[str]:
    return [separator.join((time(k), repr(float(U[k])), repr(float(Y[k])))) for k in range(N)]


def text(lines: list[str], head: str = "t,u,y") -> str:
    return "\n".join([head, *lines] if head else lines)


def insert_lines(lines: list[str], *strange: str) -> list[str]:
    return [*lines[:100], *strange, *lines[100:]]


TABLES: dict[str, tuple[str, str, str]] = {
    # text, mapping, the finding's code
    "no column names": (text(rows(), ""), "voltage=c2 velocity=c3 time=c1", "no_column_names"),
    "row of units": (text(rows(time=lambda k: str(10 * k)), "t,u,y\n[ms],[V],[rad/s]"), MAP, ""),
    "ISO times": (text(rows(time=lambda k: ISO[k] + "Z")), MAP, ""),
    "dates with a space": (text(rows(time=lambda k: ISO[k].replace("T", " "))), MAP, ""),
    "time zone offset": (text(rows(time=lambda k: ISO[k] + "+02:00")), MAP, ""),
    "time of day": (text(rows(time=lambda k: ISO[k][11:])), MAP, ""),
    "nanoseconds since 1970": (
        text(rows(time=lambda k: str(1_780_000_000_000_000_000 + 10_000_000 * k))),
        MAP,
        "time_unit",
    ),
    "milliseconds since 1970": (
        text(rows(time=lambda k: str(1_780_000_000_000 + 10 * k))),
        MAP,
        "time_unit",
    ),
    "time not starting at zero": (text(rows(time=lambda k: f"{7060 + T[k]:.2f}")), MAP, ""),
    "stray lines": (
        text(insert_lines(rows(), "t,u,y", "# restarted", "Brown-out!")),
        MAP,
        "stray_rows",
    ),
    "preamble": (text(rows(), "Scope 4000\nDate;Monday\n\nt,u,y"), MAP, ""),
    "trailing separator": (text([line + "," for line in rows()], "t,u,y,"), MAP, ""),
    "text column": (text([line + ",run" for line in rows()], "t,u,y,state"), MAP, ""),
    "names in other languages": (text(rows(), "时间,Spannung,vitesse mesurée"),
                                 "voltage=Spannung velocity=vitesse mesurée time=时间", ""),
}  # fmt: skip


@pytest.mark.parametrize("name", list(TABLES))
def test_tables_of_common_loggers_are_read(tmp_path, name):
    content, mapping, code = TABLES[name]
    (tmp_path / "log.csv").write_text(content)
    record = read_records(tmp_path / "log.csv", [mapping])["motor"]
    assert len(record) == N
    np.testing.assert_allclose(record.time, T, atol=1e-6)  # float64 since 1970: 0.2 us
    np.testing.assert_array_equal(record.voltage[1:], U[:-1])
    np.testing.assert_array_equal(record.velocity, Y)
    assert [c for c in codes(record) if c != "gear_ratio_assumed"] == [code] * bool(code)


def test_command_and_state_files_are_merged_by_time(tmp_path):
    write_table(tmp_path / "set.csv", t=T, u=U)
    write_table(tmp_path / "state.csv", time_ms=1e3 * T + 4, w=Y)
    write_table(tmp_path / "other.csv", a=[1, 3], b=[2, 4])
    record = read_one(tmp_path, ["voltage=/set.u velocity=/state.w time=t"])
    assert record.source == "set+state"
    np.testing.assert_array_equal(record.velocity, Y)
    # In each 10 ms interval the previous voltage holds for 6 ms, the next one for 4 ms.
    np.testing.assert_allclose(record.voltage[1:], 0.6 * U[:-1] + 0.4 * U[1:], rtol=1e-6)


def test_table_with_too_many_text_lines_is_refused_by_line(tmp_path):
    lines = [line if k % 10 else "Brown-out!" for k, line in enumerate(rows())]
    (tmp_path / "log.csv").write_text(text(lines))
    assert_refused("line 12, column 't': 'Brown-out!' is not a number", tmp_path / "log.csv", [MAP])


def test_step_at_first_row_is_kept(tmp_path):
    record = read_table(tmp_path, [MAP], t=T, u=N * [6], y=60 * (1 - np.exp(-T / 0.1)))
    assert len(record) == N and record.voltage[0] == 6.0 and record.velocity is not None
    assert record.velocity[0] == 0.0
