# SPDX-License-Identifier: Apache-2.0
"""Assign topics, fields and columns to the motors' signals, with their units.

The same mapping is written as a YAML file or as strings on the command line; docs/mapping.md
shows both.
"""

import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from smp_motor_control.errors import is_ros_name
from smp_motor_control.parameter_file import read_yaml
from smp_motor_ident.bag.template import parse_path
from smp_motor_ident.bag.units import check_unit
from smp_motor_ident.errors import BagError, ParameterError

SIGNALS = ("voltage", "current", "velocity", "position", "count", "supply", "direction", "time")
DESCRIBED = ("gear_ratio", "counts_per_revolution", "encoder_bits", "supply_voltage", "resistance")
"""Properties of the hardware in a ``motor_description``."""
ACCURACIES = ("current_accuracy", "voltage_accuracy", "timing_accuracy")
HARDWARE = (*DESCRIBED, *ACCURACIES)
_CHOICES = {
    "held": ("after", "before"),
    "clock": ("auto", "header", "log"),
    "shaft": ("wheel", "motor"),
}
_SECONDS = ("gap", "sample_time", "velocity_window")
_SCALES = ("wheel_radius", "pwm_full_scale", "pole_pairs")
DEFAULT_MOTOR = "motor"  # name of the motor where a mapping has only one and does not name it
_NUMBER = r"(?:\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?)"
_PRODUCT = rf"{_NUMBER}(?:\s*[*/]\s*{_NUMBER})*"
_SIGNAL_FORM = re.compile(
    rf"""(?P<source>"(?:[^"]|"")*"|.+?)
    (?P<scale>(?:\s*[*/]\s*-?{_NUMBER})*)
    (?P<offset>(?:\s*[+-]\s*{_PRODUCT})?)
    (?:\s*:\s*(?P<unit>[A-Za-zµ°%]+(?:/[a-z]+)?))?
    (?:\s*@\s*(?P<shaft>\w+))?\s*""",
    re.VERBOSE,
)
_ITEM_SEPARATOR = re.compile(r"""\s+(?=[\w./]+=[^=])(?=(?:[^"]*"[^"]*")*[^"]*$)""")
"""Blanks before another ``KEY=``, except in quotes."""
_TOPIC_FIELD = re.compile(r"(?P<topic>/[\w/-]+)\.(?P<field>.+)")


@dataclass(frozen=True)
class Signal:
    """Source of one signal; its value is ``(raw * scale + offset)`` in ``unit``."""

    topic: str  # empty for a column of a file; ``/STEM`` where several files are one recording
    field: str  # path of the field, or name of the column
    # scale, offset: applied in this order, before the unit
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""  # one that `smp_motor_ident.bag.units` knows; empty where the file may say it
    shaft: str = ""  # where velocity and position are measured; empty for the motor's choice


@dataclass(frozen=True)
class MotorMap:
    """Signals and hardware of one motor."""

    signals: Mapping[str, Signal] = field(default_factory=dict)  # by the names in `SIGNALS`
    # Any of `HARDWARE`; overrides the bag's own description
    hardware: Mapping[str, float] = field(default_factory=dict)
    held: str = ""  # whether a voltage holds from its instant on, or held up to it
    clock: str = "auto"  # which time the samples have
    shaft: str = "wheel"  # where velocity and position are measured, unless a signal says so itself
    # [s]; a longer interval without samples begins a new segment; 0: chosen by the data
    gap: float = 0.0
    sample_time: float = 0.0  # [s]; of a file that has no time; 0 where it has
    velocity_window: float = 0.0  # [s]; over which the velocity is known to be averaged
    wheel_radius: float = 0.0  # [m]; for velocities and positions of the rim
    pwm_full_scale: float = 0.0  # value of a voltage in ``pwm`` at 100 %; never guessed
    pole_pairs: float = 0.0  # of a motor whose speed is in electrical revolutions, ``erpm``
    own: bool = False  # whether these are the project's own messages, fully described

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics of the signals, each once."""
        return tuple(dict.fromkeys(signal.topic for signal in self.signals.values()))


@dataclass(frozen=True)
class SignalMap:
    """A whole mapping."""

    motors: Mapping[str, MotorMap] = field(default_factory=dict)  # by the name of the wheel
    # Settings of all motors, also of those that the bag describes itself
    defaults: MotorMap = field(default_factory=MotorMap)
    # ``.msg`` files or folders of them for types that the bag does not define
    msg_files: tuple[str, ...] = ()


def parse_mapping(items: Iterable[str], msg_files: Iterable[str] = ()) -> SignalMap:
    """Read a mapping as it is written on the command line: ``[WHEEL.]KEY=VALUE``.

    KEY is a signal, a property of the hardware or an option; an item may hold several, separated by
    blanks.
    """
    document: dict[str, Any] = {}
    motors: dict[str, dict[str, Any]] = {}
    parts = (part for whole in items for part in _ITEM_SEPARATOR.split(whole.strip()))
    for item in filter(None, parts):
        key, equals, value = item.partition("=")
        if not equals or not value.strip():
            raise BagError(f"mapping {item!r}: write KEY=VALUE, such as voltage=/pwm.data*12/255")
        wheel, dot, name = key.strip().rpartition(".")
        target = motors.setdefault(wheel, {}) if dot else document
        if name in target:
            raise BagError(f"mapping {item!r}: {key.strip()} is given twice")
        target[name] = value.strip()
    document["motors"] = motors
    document["types"] = list(msg_files)
    return from_document(document, "mapping")


def load_mapping(path: str | os.PathLike[str]) -> SignalMap:
    """Read a mapping from a YAML file; paths of its ``types`` are relative to it."""
    path = Path(path)
    try:
        document = read_yaml(path)
    except ParameterError as error:
        raise BagError(str(error)) from None
    mapping = from_document(document, str(path))
    files = tuple(str(path.parent / name) for name in mapping.msg_files)
    return replace(mapping, msg_files=files)


def from_document(document: Any, where: str = "mapping") -> SignalMap:
    """Read a mapping from plain data, as YAML gives them: ``motors``, ``types`` and options."""
    if not isinstance(document, Mapping):
        raise BagError(f"{where}: must hold keys and values, such as motors:")
    rest = dict(document)
    motors, types = rest.pop("motors", None) or {}, rest.pop("types", None) or []
    if not isinstance(motors, Mapping):
        raise BagError(f"{where}: motors must be wheel names with their signals")
    types = [types] if isinstance(types, str) else types
    if not isinstance(types, list) or not all(isinstance(name, str) for name in types):
        raise BagError(f"{where}: types must be a list of .msg files or folders")
    if signals := [name for name in rest if name in SIGNALS and name != "time"]:
        if motors:
            raise BagError(f"{where}: {signals[0]} needs its wheel: WHEEL.{signals[0]}=...")
        motors = {DEFAULT_MOTOR: {n: rest.pop(n) for n in (*signals, "time") if n in rest}}
    defaults = _read_motor(rest, where)
    for wheel in map(str, motors):
        if not is_ros_name(wheel):
            raise BagError(
                f"{where}: {wheel!r} is not a ROS name; use letters, digits and _ as left_1"
            )
    each = {str(w): _read_motor(entry, f"{where}: {w}", defaults) for w, entry in motors.items()}
    return SignalMap(each, defaults, tuple(types))


def read_mapping(mapping: Any) -> SignalMap:
    """Return any form of a mapping as `SignalMap`."""
    if mapping is None:
        return SignalMap()
    if isinstance(mapping, SignalMap):
        return mapping
    if isinstance(mapping, Mapping):
        return from_document(mapping)
    if isinstance(mapping, str) and "=" in mapping:
        return parse_mapping([mapping])
    if isinstance(mapping, (str, os.PathLike)):
        return load_mapping(mapping)
    return parse_mapping(mapping)


def _read_motor(entry: Any, where: str, defaults: MotorMap | None = None) -> MotorMap:
    """Return one motor's part, validated, with the common settings as defaults."""
    if not isinstance(entry, Mapping):
        raise BagError(f"{where}: must hold keys and values")
    motor = defaults or MotorMap()
    signals, hardware = dict(motor.signals), dict(motor.hardware)
    options: dict[str, Any] = {}
    for key, value in entry.items():
        place = f"{where}: {key}"
        if key in SIGNALS:
            signals[key] = _read_signal(key, value, place)
        elif key in HARDWARE:
            hardware[key] = _read_positive(value, place, zero=key in ("encoder_bits", *ACCURACIES))
        elif key in (*_SECONDS, *_SCALES):
            options[key] = _read_positive(value, place, zero=key in _SECONDS)
        elif key in _CHOICES:
            options[key] = _check_choice(key, value, place)
        else:
            known = ", ".join((*SIGNALS, *HARDWARE, *_CHOICES, *_SECONDS, *_SCALES))
            raise BagError(f"{place} is not a key of a mapping; use {known}")
    if (bits := hardware.get("encoder_bits", 0)) != int(bits) or bits > 64:
        raise BagError(f"{where}: encoder_bits is {bits}; it must be a whole number from 0 to 64")
    return replace(motor, signals=signals, hardware=hardware, **options)


def _check_choice(key: str, value: Any, place: str) -> str:
    if value not in _CHOICES[key]:
        raise BagError(f"{place} is {value!r}; use {' or '.join(_CHOICES[key])}")
    return str(value)


def _read_positive(value: Any, place: str, *, zero: bool) -> float:
    number = _read_number(value, place)
    if number < 0 or (number == 0 and not zero) or not math.isfinite(number):
        raise BagError(f"{place} is {value}; it must be a {'' if zero else 'positive '}number")
    return number


def _read_number(value: Any, place: str) -> float:
    """Return a number, given as such or as a product such as ``12/255``."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    text = str(value).strip()
    sign = -1.0 if text.startswith("-") else 1.0
    text = text.lstrip("+-").strip()
    if not re.fullmatch(_PRODUCT, text):
        raise BagError(f"{place} is {value!r}; it must be a number or a product such as 12/255")
    return _multiply(sign, text, f"{place}: {value!r}")


def _multiply(result: float, factors: str, place: str) -> float:
    """Multiply by a product such as ``12/255`` or ``*12/255``."""
    for operator, factor in re.findall(rf"([*/]?)\s*(-?{_NUMBER})", factors):
        if operator == "/" and float(factor) == 0:
            raise BagError(f"{place} divides by zero")
        result = result / float(factor) if operator == "/" else result * float(factor)
    return result


def _read_signal(name: str, value: Any, place: str) -> Signal:
    if isinstance(value, Mapping):
        unknown = set(value) - {"topic", "field", "column", "scale", "offset", "unit", "shaft"}
        if unknown:
            raise BagError(f"{place}: {sorted(unknown)[0]!r} is not a key of a signal")
        source = value.get("field", value.get("column"))
        if not isinstance(source, str):
            raise BagError(f"{place}: needs topic and field, or a column")
        topic, unit, shaft = (str(value.get(key, "")) for key in ("topic", "unit", "shaft"))
        scale = _read_number(value.get("scale", 1.0), f"{place}: scale")
        offset = _read_number(value.get("offset", 0.0), f"{place}: offset")
        signal = Signal(topic, source, scale, offset, unit, shaft)
    else:
        signal = _parse_signal(str(value), place)
    constant = name == "voltage" and signal.offset != 0  # a constant level
    if not (signal.scale or constant) or not math.isfinite(signal.scale):
        raise BagError(f"{place}: its scale is {signal.scale}; it must be finite and not 0")
    if signal.shaft:
        _check_choice("shaft", signal.shaft, place)
    if signal.topic:
        parse_path(signal.field)
    try:
        return replace(signal, unit=check_unit(name, signal.unit) if signal.unit else "")
    except BagError as error:
        raise BagError(f"{place}: {error}") from None


def _parse_signal(text: str, place: str) -> Signal:
    """Read ``SOURCE[*SCALE][+OFFSET][:UNIT][@SHAFT]``."""
    match = _SIGNAL_FORM.fullmatch(text)
    if match is None:
        raise BagError(f"{place}: {text!r} is not SOURCE[*SCALE][+OFFSET][:UNIT][@SHAFT]")
    source = match["source"].strip()
    scale = _multiply(1.0, match["scale"], f"{place}: {text!r}")
    offset = _read_number(match["offset"].replace(" ", "") or "0", place)
    named = _TOPIC_FIELD.fullmatch(source)  # anything else is a column, or in quotes
    path = source[1:-1].replace('""', '"') if source.startswith('"') else source
    topic, path = (named["topic"], named["field"].strip()) if named else ("", path)
    return Signal(topic, path, scale, offset, match["unit"] or "", match["shaft"] or "")
