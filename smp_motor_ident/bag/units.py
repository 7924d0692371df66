"""Units a recording may come in, and what makes SI of them."""

import math
import re

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
    "direction": {"": 1.0},
}
"""By signal: unit to factor; the first of each is assumed where none is given."""

_METRES = {
    "velocity": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6, "ft/s": 0.3048},
    "position": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "ft": 0.3048},
}
"""Units of the rim, which need the wheel's radius."""
_COUNTS = {"velocity": "ticks/s", "position": "ticks"}
_DUTY = {"duty": 1.0, "%": 1e-2}
_PWM = "pwm"
_ALIASES = {
    alias: unit
    for unit, aliases in {
        "ticks": ("count", "counts", "tick"),
        "ticks/s": ("counts/s",),
        "V": ("volt", "volts"),
        "A": ("ampere", "amperes", "amps"),
        "%": ("percent", "pct"),
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


def _known(signal: str) -> list[str]:
    known = [*FACTORS[signal], *_METRES.get(signal, {})]
    known += [_COUNTS[signal]] if signal in _COUNTS else []
    return known + ([*_DUTY, _PWM] if signal == "voltage" else [])


def check_unit(signal: str, unit: str) -> str:
    """Return the unit under its usual name, the first of the signal's where none is given."""
    known = _known(signal)
    if not unit:
        return known[0]
    unit = unit.strip()
    named = _ALIASES.get(unit.lower(), unit)
    for candidate in known:
        if named == candidate or (named.lower() == candidate.lower() and candidate != "mV"):
            return candidate
    raise BagError(f"{signal} cannot be in {unit!r}; use one of {', '.join(known)}")


def of_the_rim(signal: str, unit: str) -> bool:
    """Return whether a unit is a length, or a length in time, which needs the wheel's radius."""
    return unit in _METRES.get(signal, {})


def is_share(unit: str) -> bool:
    """Return whether a voltage in this unit is a share of the supply."""
    return unit in (*_DUTY, _PWM)


def written_unit(text: str) -> str | None:
    """Return the unit that a file writes beside a column's name; None where it is none."""
    if text.strip() in ("", "-", "1", "."):
        return ""
    for signal in FACTORS:
        try:
            return check_unit(signal, text)
        except BagError:
            continue
    return None


def unit_of(signal: str, written: str, name: str) -> str:
    """Return the unit that a file writes of a signal, or else a word of its name that is one.

    Empty where there is none but SI.  A single letter is none: ``theta_m`` is the motor's angle.
    """
    words = re.split(r"[\W_]+(?:per[\W_]+)?|(?<=[a-z]{2})(?=[A-Z])", name)
    ends = [text for k in range(len(words)) for text in (words[k], "/".join(words[k : k + 2]))]
    for text in [written] if written else ends[::-1]:
        try:
            unit = check_unit(signal, text) if written or len(text) > 1 else ""
        except BagError:
            continue
        # What a name may call the signal itself is no unit.
        if written or unit not in ("", _known(signal)[0], "duty", _PWM):
            return unit
    return ""


def factor(
    signal: str,
    unit: str,
    *,
    counts_per_revolution: float | None = None,
    supply_voltage: float | None = None,
    wheel_radius: float = 0.0,
    pwm_full_scale: float = 0.0,
) -> float:
    """Return what a value in the unit must be multiplied by; BagError names what is missing."""
    if unit in FACTORS[signal]:
        return FACTORS[signal][unit]
    if of_the_rim(signal, unit):
        if not wheel_radius:
            raise BagError(
                f"a {signal} in {unit!r} needs wheel_radius: give --map wheel_radius=METRES"
            )
        return _METRES[signal][unit] / wheel_radius
    if unit == _PWM and not pwm_full_scale:
        raise BagError("a voltage in 'pwm' needs pwm_full_scale, the value that is 100 %")
    if is_share(unit):
        if supply_voltage is None:
            raise BagError(f"a voltage in {unit!r} needs supply_voltage or a supply signal")
        return (_DUTY[unit] if unit in _DUTY else 1 / pwm_full_scale) * supply_voltage
    if counts_per_revolution is None:
        raise BagError(f"a {signal} in {unit!r} needs counts_per_revolution")
    return _TURN / counts_per_revolution
