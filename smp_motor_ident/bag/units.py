# SPDX-License-Identifier: Apache-2.0
"""Units of recordings and their conversion to SI."""

import math
import re
from collections.abc import Mapping
from itertools import pairwise, product, zip_longest
from typing import NamedTuple

from smp_motor_ident.errors import BagError


class Unit(NamedTuple):
    """A factor to SI, times powers of properties of the robot."""

    factor: float
    needs: Mapping[str, int] = {}


_TURN = 2 * math.pi
_DUTY, _RIM, _COUNTS = {"supply_voltage": 1}, {"wheel_radius": -1}, {"counts_per_revolution": -1}
_NEEDED = {
    "wheel_radius": "wheel_radius: give --map wheel_radius=METRES",
    "pwm_full_scale": "pwm_full_scale, the value that is 100 %",
    "pole_pairs": "pole_pairs of the motor, as erpm counts electrical revolutions",
    "supply_voltage": "supply_voltage or a supply signal",
    "counts_per_revolution": "counts_per_revolution",
}

_ROWS: tuple[tuple[str, Mapping[str, int], dict[str, float]], ...] = (
    ("voltage", {}, {"V": 1.0, "mV": 1e-3, "kV": 1e3}),
    ("voltage", _DUTY, {"duty": 1.0, "%": 1e-2}),
    ("voltage", {"pwm_full_scale": -1, **_DUTY}, {"pwm": 1.0}),
    ("supply", {}, {"V": 1.0, "mV": 1e-3}),
    ("current", {}, {"A": 1.0, "mA": 1e-3}),
    ("velocity", {}, {"rad/s": 1.0, "deg/s": _TURN / 360, "rpm": _TURN / 60, "rev/s": _TURN}),
    ("velocity", {}, {"Hz": _TURN, "mrad/s": 1e-3, "rad/min": 1 / 60, "deg/min": _TURN / 21600}),
    ("velocity", {"pole_pairs": -1}, {"erpm": _TURN / 60}),
    ("velocity", _RIM, {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6}),
    ("velocity", _RIM, {"ft/s": 0.3048, "in/s": 0.0254}),
    ("velocity", _COUNTS, {"ticks/s": _TURN}),
    ("position", {}, {"rad": 1.0, "deg": _TURN / 360, "rev": _TURN, "mrad": 1e-3}),
    ("position", _RIM, {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "ft": 0.3048, "in": 0.0254}),
    ("position", _COUNTS, {"ticks": _TURN}),
    ("count", {}, {"ticks": 1.0}),
    ("time", {}, {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}),
    ("direction", {}, {"": 1.0}),
)
UNITS: dict[str, dict[str, Unit]] = {signal: {} for signal, _, _ in _ROWS}
"""Units by signal; the first one is the default."""
for _signal, _needs, _factors in _ROWS:
    UNITS[_signal] |= {unit: Unit(value, _needs) for unit, value in _factors.items()}

_ALIASES = {
    alias: unit
    for unit, aliases in {
        "ticks": ("count", "counts", "tick"),
        "ticks/s": ("counts/s",),
        "V": ("volt", "volts"),
        "A": ("ampere", "amperes", "amps"),
        "%": ("percent", "pct", "prozent", "porcentaje", "porcentagem", "percentuale"),
        "rev/s": ("rps",),
        "rpm": ("rev/min", "u/min", "1/min"),
        "rev": ("turn", "turns"),
        "deg": ("degree", "degrees", "°"),
        "deg/s": ("°/s", "dps"),
        "s": ("sec", "seconds"),
        "ms": ("msec", "millis", "milliseconds"),
        "us": ("µs", "usec", "micros", "microseconds"),
        "km/h": ("kph",),
        "m/s": ("mps",),
    }.items()
    for alias in aliases
}

_WORDS = {
    **{"rotation": "rev", "rot": "rev", "turn": "rev", "radian": "rad", "degree": "deg"},
    **{"meter": "m", "metre": "m", "foot": "ft", "feet": "ft", "inch": "in", "inche": "in"},
    **{"amp": "A", "second": "s", "sec": "s", "minute": "min", "hour": "h"},
}
"""Units by their English names, in the singular."""

_BODY_VECTORS = {
    "velocity": r"linear\.[xyz]$",  # Twist
    "position": r"(?:position|translation)\.[xyz]$",  # Pose, Transform
}


def check_unit(signal: str, unit: str) -> str:
    """Return the unit under its usual name, the first of the signal's where none is given."""
    known = list(UNITS[signal])
    if not unit:
        return known[0]
    unit = unit.strip()
    named = _ALIASES.get(unit.lower(), unit)
    for candidate in known:
        if named == candidate or (named.lower() == candidate.lower() and candidate != "mV"):
            return candidate
    raise BagError(f"{signal} cannot be in {unit!r}; use one of {', '.join(known)}")


def needs(signal: str, unit: str, name: str) -> bool:
    """Return whether a unit of a signal needs a property such as ``wheel_radius``."""
    one = UNITS.get(signal, {}).get(unit)
    return one is not None and name in one.needs


def parse_unit(text: str) -> str | None:
    """Return the unit that a file writes next to a column's name; None if it is not a unit.

    It is a symbol, or in words as WPILib writes it: "Rotation per Second", "turns_per_second".
    """
    if text.strip() in ("", "-", "1", "."):
        return ""
    for signal, form in product(UNITS, (text, _abbreviate(text))):
        try:
            return check_unit(signal, form)
        except BagError:
            continue
    return None


def _abbreviate(text: str) -> str:
    """Return the symbol of a unit in words."""
    parts = re.split(r"[\s_]per[\s_]|/", text.strip().lower())
    return "/".join(_WORDS.get(part.strip().removesuffix("s"), part) for part in parts)


def find_unit(signal: str, written: str, name: str) -> str:
    """Return the unit that a file states for a signal, or else one in the signal's name.

    Empty for SI.  A single letter is not a unit: ``theta_m`` is the motor's angle.  The vectors of
    ``geometry_msgs`` are those of a body, in metres.
    """
    if not written and re.search(_BODY_VECTORS.get(signal, "$^"), name):
        return "m/s" if signal == "velocity" else "m"
    words = re.split(r"[\W_]+(?:per[\W_]+)?|(?<=[a-z]{2})(?=[A-Z])", name)
    words = [word for word in words if word.lower() != "per"]
    pairs = [_abbreviate("/".join(two)) for two in pairwise(words)]
    ends = [text for both in zip_longest(words, pairs, fillvalue="") for text in both]
    for text in [written] if written else ends[::-1]:
        try:
            unit = check_unit(signal, text) if written or len(text) > 1 else ""
        except BagError:
            continue
        # A word that names the signal itself is not a unit.
        if written or unit not in ("", next(iter(UNITS[signal])), "duty", "pwm", "in", "in/s"):
            return unit
    return ""


def factor(signal: str, unit: str, known: Mapping[str, float | None]) -> float:
    """Return the factor from a unit to SI; BagError if a property is unknown (None or 0)."""
    result, needed = UNITS[signal][unit]
    for name, power in needed.items():
        if not (value := known.get(name)):
            raise BagError(f"a {signal} in {unit!r} needs {_NEEDED[name]}")
        result *= value**power
    return result
