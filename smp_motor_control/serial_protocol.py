"""The line protocol between a host and a motor board, for the simplest firmware.

Lines of ASCII that end with ``*`` and the exclusive-or of the characters before it in two
hexadecimal digits, as NMEA 0183 sentences do; a line whose sum does not fit is dropped.

======================================= ==============================================
host to board, at most 0.1 s apart      ``V,MV,MV,...``: armature voltages [mV]
board to host, at its sampling instants ``S,US,BATTERY,COUNT,MA,COUNT,MA,...``
======================================= ==============================================

``US`` is the board's clock [us, modulo 2^32], ``BATTERY`` its supply [mV], ``COUNT`` a signed
encoder count and ``MA`` a current [mA], empty where it is not measured.  A board that hears no
valid line for 0.2 s turns its motors off.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from smp_motor_control.errors import ParameterError

LONGEST = 512
"""Characters without an end of line after which they are noise."""

CLOCK = 1 << 32
"""The board's clock begins anew after so many microseconds."""


class BoardState(NamedTuple):
    """What a board reported at one instant."""

    clock: int  # [us], wraps
    battery: float  # [V]
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


def decode_state(line: str, motors: int) -> BoardState:
    """Read a board's line."""
    text, _, sum_ = line.strip().rpartition("*")
    fields = text.split(",")
    if checksum(text) != sum_.upper() or fields[0] != "S":
        raise ParameterError(f"spoilt line {line[:40]!r}")
    if len(fields) != 3 + 2 * motors:
        raise ParameterError(f"line of {(len(fields) - 3) // 2} motors, not of {motors}")
    try:
        clock, battery = int(fields[1]), 1e-3 * int(fields[2])
        counts = tuple(int(field) for field in fields[3::2])
        currents = tuple(1e-3 * int(field) if field else math.nan for field in fields[4::2])
    except ValueError:
        raise ParameterError(f"line with a field that is no number: {line[:40]!r}") from None
    return BoardState(clock % CLOCK, battery, counts, currents)


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
