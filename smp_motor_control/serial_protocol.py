"""The line protocol between a host and a motor board, for the simplest firmware.

Lines of ASCII that end with ``*`` and the exclusive-or of the characters before it in two
hexadecimal digits, as NMEA 0183 sentences do; a line whose sum does not fit is dropped.

============================================= ========================================
board to host, at its samples, <= 0.1 s apart ``S,US,BATTERY,COUNT,MA,COUNT,MA,...``
host to board, <= 0.1 s apart                 ``A,US`` and ``V,MV,MV,...``
============================================= ========================================

``US`` is the board's clock [us, modulo 2^32], ``BATTERY`` its supply [mV], ``COUNT`` a signed
encoder count and ``MA`` a current [mA]; battery and current are empty where they are not measured.
``V`` holds the armature voltages [mV], and the ``A`` before it the clock of the newest ``S`` that
the host has heard: a board that compares it with its own clock knows how old the command is, and
drops what waited in a queue.  A board that hears no valid, fresh ``V`` for 0.2 s turns its motors
off; a host that hears no ``S`` for as long sends nothing.
"""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from smp_motor_control.errors import ParameterError

LONGEST = 512
"""Characters without an end of line after which they are noise."""

CLOCK = 1 << 32
"""The board's clock begins anew after so many microseconds."""


_INTEGER = re.compile(r"-?[0-9]{1,18}")
"""What fits 64 bits and every counter."""


class BoardState(NamedTuple):
    """What a board reported at one instant."""

    clock: int  # [us], wraps
    battery: float  # [V]; NaN where not measured
    counts: tuple[int, ...]  # of each motor's encoder
    currents: tuple[float, ...]  # [A]; NaN where not measured


def checksum(text: str) -> str:
    """Return the exclusive-or of characters, as two hexadecimal digits."""
    total = 0
    for character in text.encode("ascii", "replace"):
        total ^= character
    return f"{total:02X}"


def encode(text: str) -> bytes:
    """Return a line with its sum."""
    return f"{text}*{checksum(text)}\n".encode("ascii")


def encode_voltages(voltages: Sequence[float]) -> bytes:
    r"""Return the command of all motors.

    Examples
    --------
    >>> encode_voltages([1.5, -12.0])
    b'V,1500,-12000*4C\n'
    """
    numbers = [round(1e3 * v) if math.isfinite(v) else 0 for v in voltages]
    return encode(",".join(["V", *map(str, numbers)]))


def encode_age(clock: int) -> bytes:
    r"""Return the line that tells a board which of its states the next command answers.

    Examples
    --------
    >>> encode_age(20000)
    b'A,20000*5F\n'
    """
    return encode(f"A,{clock}")


def decode_state(line: str, motors: int) -> BoardState:
    """Read a board's line."""
    text, _, sum_ = line.strip().rpartition("*")
    fields = text.split(",")
    if checksum(text) != sum_.upper() or fields[0] != "S":
        raise ParameterError(f"spoilt line {line[:40]!r}")
    if len(fields) != 3 + 2 * motors:
        raise ParameterError(f"line of {(len(fields) - 3) // 2} motors, not of {motors}")
    counts, currents = fields[3::2], fields[4::2]
    for field in (fields[1], *counts, *filter(None, (fields[2], *currents))):
        if not _INTEGER.fullmatch(field):
            raise ParameterError(f"line with a field that is no whole number: {line[:40]!r}")
    return BoardState(
        int(fields[1]) % CLOCK,
        _thousandth(fields[2]),
        tuple(map(int, counts)),
        tuple(map(_thousandth, currents)),
    )


def _thousandth(field: str) -> float:
    return 1e-3 * int(field) if field else math.nan


class Lines:
    """Cuts a stream of bytes into lines."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[str]:
        """Return the lines that are whole now."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST:
            self._rest = b""
        return [line.decode("ascii", "replace") for line in lines]
