"""Units a recording may come in, and what makes SI of them."""

from __future__ import annotations

import math

from smp_motor_ident.errors import BagError

_TURN = 2 * math.pi

FACTORS: dict[str, dict[str, float]] = {
    "voltage": {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    "supply": {"V": 1.0, "mV": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
    "velocity": {
        "rad/s": 1.0,
        "deg/s": math.pi / 180,
        "rpm": _TURN / 60,
        "rev/s": _TURN,
        "Hz": _TURN,
        "mrad/s": 1e-3,
        "rad/min": 1 / 60,
        "deg/min": math.pi / 10800,
    },
    "position": {"rad": 1.0, "deg": math.pi / 180, "rev": _TURN, "mrad": 1e-3},
    "count": {"ticks": 1.0},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
}
"""By signal: unit to factor; the first of each is assumed where none is given."""

_COUNTS = {"velocity": "ticks/s", "position": "ticks"}
_DUTY = {"duty": 1.0, "%": 1e-2}
_ALIASES = {
    "count": "ticks",
    "counts": "ticks",
    "tick": "ticks",
    "counts/s": "ticks/s",
    "volt": "V",
    "volts": "V",
    "percent": "%",
    "rps": "rev/s",
    "turns": "rev",
    "turn": "rev",
    "degree": "deg",
    "degrees": "deg",
    "dps": "deg/s",
    "µs": "us",
    "sec": "s",
}


def check_unit(signal: str, unit: str) -> str:
    """Return the unit under its usual name."""
    known = [*FACTORS[signal], *([_COUNTS[signal]] if signal in _COUNTS else [])]
    if signal == "voltage":
        known += _DUTY
    if not unit:
        return known[0]
    unit = unit.strip()
    named = _ALIASES.get(unit.lower(), unit)
    for candidate in known:
        if named == candidate or (named.lower() == candidate.lower() and candidate != "mV"):
            return candidate
    raise BagError(f"{signal} cannot be in {unit!r}; use one of {', '.join(known)}")


def factor(
    signal: str, unit: str, *, counts_per_revolution: float | None, supply_voltage: float | None
) -> float:
    """Return what a value in the unit must be multiplied by."""
    if unit in FACTORS[signal]:
        return FACTORS[signal][unit]
    if unit in _DUTY:
        if supply_voltage is None:
            raise BagError(f"a voltage in {unit!r} needs supply_voltage or a supply signal")
        return _DUTY[unit] * supply_voltage
    if counts_per_revolution is None:
        raise BagError(f"a {signal} in {unit!r} needs counts_per_revolution")
    return _TURN / counts_per_revolution
