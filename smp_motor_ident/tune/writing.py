"""Designs as files: the parameter file of the wheel nodes, and ``gains.json``."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

from smp_motor_control.parameter_file import written
from smp_motor_ident.result import plain
from smp_motor_ident.tune.designer import Design

SCHEMA = 1


def parameters(design: Design) -> dict[str, Any]:
    """Return the parameters of one wheel's ``wheel_pid`` node."""
    gains = dataclasses.asdict(design.gains)
    gains.pop("error_deadband")
    ratio, reference = design.loop.gear_ratio, design.reference
    limit = reference.max_acceleration
    return {
        **gains,
        "max_velocity": float(reference.max_velocity / ratio),
        "max_acceleration": float(limit / ratio) if math.isfinite(limit) else 0.0,
        "transition_time": float(reference.transition_time),
        "reference_delay": float(reference.lag),
        "reference_doubt": float(reference.doubt),
        "drive": {
            "top_speed": float(reference.drive.top_speed / ratio),
            "time_constant": float(reference.drive.time_constant),
            "time_constant_product": float(reference.drive.time_constant_product),
        },
        "speed_source": str(design.loop.speed_source),
        "difference_window": int(max(design.loop.difference_window, 1)),
        "model": {name: float(value) for name, value in design.motor.items()},
    }


def gains_yaml(designs: Mapping[str, Design], provenance: Iterable[str]) -> str:
    """Return the parameter file of all wheel nodes."""
    nodes = {f"/**/{wheel}/wheel_pid": parameters(design) for wheel, design in designs.items()}
    return written(nodes, provenance)


def gains_document(
    designs: Mapping[str, Design], provenance: Mapping[str, Any], reason: str
) -> dict[str, Any]:
    """Return the content of ``gains.json``."""
    return {
        "schema": SCHEMA,
        "provenance": dict(provenance),
        "reason": reason,
        "wheels": {wheel: _entry(design) for wheel, design in designs.items()},
    }


def _entry(design: Design) -> dict[str, Any]:
    ratio, reference, bands = design.loop.gear_ratio, design.reference, design.specification
    entry = {name: getattr(design, name) for name in _WRITTEN}
    entry["specification"] = dataclasses.replace(bands, change=bands.change / ratio)
    entry["reference"] = {
        "max_velocity": reference.max_velocity / ratio,
        "max_acceleration": reference.max_acceleration / ratio,
        "transition_time": reference.transition_time,
        "lag": reference.lag,
        "doubt": reference.doubt,
        "top_speed": reference.drive.top_speed / ratio,
    }
    entry["loop"] = dataclasses.replace(design.loop, delay=design.loop.loop_delay)
    return dict(plain(entry))


_WRITTEN = (
    "method", "reason", "warnings", "gains", "margins", "robustness", "findings", "performance",
    "specification", "reference", "loop", "motor", "sensor",
)  # fmt: skip
"""What of a design stands in ``gains.json``, wheel quantities at the wheel."""
