# SPDX-License-Identifier: Apache-2.0
"""Serial line protocol between a host and a motor board.

Lines are ASCII and end with ``*`` and the exclusive-or of the preceding characters in two
hexadecimal digits, as in NMEA 0183; lines with a wrong checksum are dropped.

============================================= ========================================
board to host, at its samples, <= 0.1 s apart ``S,US,BATTERY,COUNT,MA,COUNT,MA,...``
host to board, <= 0.1 s apart                 ``A,US`` and ``V,MV,MV,...``
============================================= ========================================

``US`` is the board's clock [us, modulo 2^32], ``BATTERY`` its supply [mV], ``COUNT`` a signed
encoder count and ``MA`` a current [mA]; battery and current are empty if not measured.  ``V``
holds the armature voltages [mV].  The ``A`` before it repeats the clock of the newest ``S``
received, from which the board computes the age of the command and drops old ones.  Without a
fresh ``V`` for 0.2 s the board turns its motors off; without an ``S`` for 0.2 s the host sends
nothing.
"""

import math
import re
from collections.abc import Sequence
from functools import reduce
from operator import xor
from typing import NamedTuple

from smp_motor_control.errors import ParameterError

MAX_LINE_LENGTH = 512  # longer lines are discarded as noise

CLOCK_PERIOD_US = 1 << 32  # range of the board's clock [us]


_INTEGER = re.compile(r"-?[0-9]{1,18}")  # whole numbers that fit in 64 bits


class BoardState(NamedTuple):
    """State reported by a board."""

    clock: int  # [us], wraps
    battery: float  # [V]; NaN if not measured
    counts: tuple[int, ...]  # encoder counts of the motors
    currents: tuple[float, ...]  # [A]; NaN if not measured


def checksum(text: str) -> str:
    """Return the exclusive-or of the characters as two hexadecimal digits."""
    return f"{reduce(xor, text.encode('ascii', 'replace'), 0):02X}"


def encode(text: str) -> bytes:
    """Return a line with its checksum."""
    return f"{text}*{checksum(text)}\n".encode("ascii")


def encode_voltages(voltages: Sequence[float]) -> bytes:
    """Return the command line of all motors."""
    numbers = [round(1e3 * v) if math.isfinite(v) else 0 for v in voltages]
    return encode(",".join(["V", *map(str, numbers)]))


def encode_age(clock: int) -> bytes:
    """Return the line with the clock of the state that the next command responds to."""
    return encode(f"A,{clock}")


def decode_state(line: str, motors: int) -> BoardState:
    """Parse a line from the board."""
    text, _, sum_ = line.strip().rpartition("*")
    fields = text.split(",")
    if checksum(text) != sum_.upper() or fields[0] != "S":
        raise ParameterError(f"line with a wrong checksum: {line[:40]!r}")
    if len(fields) != 3 + 2 * motors:
        raise ParameterError(f"line with {(len(fields) - 3) // 2} motors instead of {motors}")
    counts, currents = fields[3::2], fields[4::2]
    for field in (fields[1], *counts, *filter(None, (fields[2], *currents))):
        if not _INTEGER.fullmatch(field):
            raise ParameterError(f"line with a field that is not a whole number: {line[:40]!r}")
    return BoardState(
        int(fields[1]) % CLOCK_PERIOD_US,
        _parse_thousandths(fields[2]),
        tuple(map(int, counts)),
        tuple(map(_parse_thousandths, currents)),
    )


def _parse_thousandths(field: str) -> float:
    return 1e-3 * int(field) if field else math.nan


class LineSplitter:
    """Split a stream of bytes into lines."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[str]:
        """Return the lines completed by new data."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > MAX_LINE_LENGTH:
            self._rest = b""
        return [line.decode("ascii", "replace") for line in lines]
