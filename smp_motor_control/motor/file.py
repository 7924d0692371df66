# SPDX-License-Identifier: Apache-2.0
"""Motors in a ROS parameter file.

::

    /**/motor_plant:
      ros__parameters:
        motors:
          front_left:
            resistance: 12.919        # or the combinations dc_gain, time_constant,
            inductance: 0.30994       # time_constant_product and static_voltage
            ...
"""

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from smp_motor_control import check_wheel_names
from smp_motor_control.encoder import Encoder
from smp_motor_control.errors import ParameterError, check_positive
from smp_motor_control.motor.parameters import (
    COMBINATIONS,
    PHYSICAL,
    Gearbox,
    MotorParameters,
    check_supply,
)
from smp_motor_control.parameter_file import read_parameters

HARDWARE_DEFAULTS = {
    "gear_ratio": 1.0,
    "counts_per_revolution": 500.0,
    "encoder_bits": 0,
    "supply_voltage": 12.0,
    "delay": 0.0,
}
"""Optional keys next to the motor's parameters, with their defaults."""

_OPTIONAL = ("coulomb_friction", "time_constant_product", "static_voltage")


@dataclass(frozen=True)
class Wiring:
    """Wiring faults between a motor and its driver, for simulations."""

    leads: int = 1  # -1: swapped
    encoder: int = 1  # -1: channels swapped
    dead_zone: float = 0.0  # commands up to this give 0 V [V]
    described_gear_ratio: float = 0.0  # published ratio; 0: the true one

    def __post_init__(self) -> None:
        for name in ("leads", "encoder"):
            if getattr(self, name) not in (1, -1):
                raise ParameterError(
                    f"{name} is {getattr(self, name)!r}; it must be 1, or -1 where swapped"
                )
        for name in ("dead_zone", "described_gear_ratio"):
            check_positive(name, getattr(self, name), or_zero=True)


WIRING_KEYS = tuple(field.name for field in fields(Wiring))


@dataclass(frozen=True)
class MotorEntry:
    """One motor of a file with its gearbox, encoder and supply."""

    parameters: MotorParameters  # at the motor shaft
    gearbox: Gearbox  # between motor and wheel
    encoder: Encoder  # on the motor shaft
    supply_voltage: float  # [V]
    delay: float = 0.0  # from command to effect [s]
    # As given by the file [ohm]; NaN for a file with combinations only, for which the currents and
    # torques of ``parameters`` are meaningless
    resistance: float = math.nan
    wiring: Wiring = Wiring()

    @property
    def knows_current(self) -> bool:
        """Whether the parameters determine the current."""
        return not math.isnan(self.resistance)


PAPER_MOTORS = "motors_paper.yaml"


def find_config(name: str) -> Path:
    """Return the path of a file in ``config``, installed or in the sources."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    shares = [Path(prefix, "share", "smp_motor_control") for prefix in prefixes if prefix]
    for place in (*shares, Path(__file__).resolve().parents[2]):
        if (path := place / "config" / name).is_file():
            return path
    raise ParameterError(f"config/{name} is not installed; build smp_motor_control again")


def load_motors(path: str | Path, wheels: Iterable[str] | None = None) -> dict[str, MotorEntry]:
    """Read the motors of the first node that has some in a ROS parameter file."""
    for parameters in read_parameters(path).values():
        if motors := extract_motors(parameters):
            return parse_motors(motors, str(path), wheels)
    raise ParameterError(
        f"{path}: has no motors; expected NODE: ros__parameters: motors: front_left: ..."
    )


def extract_motors(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the motors in the parameters of a node, by wheel."""
    start = "motors."
    return nest_parameters(
        {n.removeprefix(start): v for n, v in parameters.items() if n.startswith(start)}
    )


def nest_parameters(dotted: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested mappings from ROS parameter names with dots."""
    top: dict[str, Any] = {}
    for key, value in dotted.items():
        *way, last = key.split(".")
        level = top
        for part in way:
            inner = level.setdefault(part, {})
            level = inner if isinstance(inner, dict) else {}
        level[last] = value
    return top


def parse_motors(
    motors: Mapping[str, Any], source: str, wheels: Iterable[str] | None = None
) -> dict[str, MotorEntry]:
    """Return the motors of a nested mapping."""
    entries = {str(name): _parse_entry(motors[name], f"{source}: {name}") for name in motors}
    try:
        check_wheel_names(list(entries))
    except ParameterError as error:
        raise ParameterError(f"{source}: {error}") from None
    missing = [wheel for wheel in wheels or () if wheel not in entries]
    if missing or not entries:
        have = ", ".join(entries) or "none"
        raise ParameterError(
            f"{source}: motor {missing[0] if missing else ''} is missing; has {have}"
        )
    return entries


def _parse_entry(values: Any, where: str) -> MotorEntry:
    if not isinstance(values, Mapping):
        raise ParameterError(f"{where}: is {values!r}; expected the motor's parameters")
    combined = any(name in values for name in COMBINATIONS)
    names = (*COMBINATIONS, "resistance") if combined else PHYSICAL
    known = (*names, *HARDWARE_DEFAULTS, *WIRING_KEYS)
    for key in values:
        if key not in known:
            raise ParameterError(f"{where}: unknown key {key!r}; known are {', '.join(known)}")
    for name in names:
        if name not in (*values, *_OPTIONAL) and not (combined and name == "resistance"):
            raise ParameterError(f"{where}: {name} is missing")
    numbers = {key: _parse_number(value, f"{where}: {key}") for key, value in values.items()}
    try:
        return _build_entry(combined, numbers)
    except ParameterError as error:
        raise ParameterError(f"{where}: {error}") from None


def _build_entry(combined: bool, numbers: dict[str, float]) -> MotorEntry:
    hardware = {key: numbers.pop(key, default) for key, default in HARDWARE_DEFAULTS.items()}
    faults: dict[str, Any] = {key: numbers.pop(key) for key in WIRING_KEYS if key in numbers}
    check_supply("supply_voltage", hardware["supply_voltage"])
    check_positive("delay", hardware["delay"], "s", or_zero=True)
    bits = hardware["encoder_bits"]
    return MotorEntry(
        parameters=(MotorParameters.from_combinations if combined else MotorParameters)(**numbers),
        gearbox=Gearbox(hardware["gear_ratio"]),
        encoder=Encoder(hardware["counts_per_revolution"], int(bits) if bits == int(bits) else -1),
        supply_voltage=hardware["supply_voltage"],
        delay=hardware["delay"],
        resistance=numbers.get("resistance", math.nan),
        wiring=Wiring(**faults),
    )


def _parse_number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ParameterError(f"{where} is {value!r}; it must be a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ParameterError(f"{where} is {value!r:.40}; it must be finite")
    return number
