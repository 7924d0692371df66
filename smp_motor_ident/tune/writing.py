"""Designs as files: the parameter file of the wheel nodes, and ``gains.json``."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

import yaml

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
    tree = {
        f"/**/{wheel}/wheel_pid": {"ros__parameters": parameters(design)}
        for wheel, design in designs.items()
    }
    head = "".join(f"# {line}\n" for line in provenance)
    return head + yaml.safe_dump(tree, sort_keys=False)


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
    entry = {
        "method": design.method,
        "reason": design.reason,
        "warnings": list(design.warnings),
        "gains": dataclasses.asdict(design.gains),
        "margins": dataclasses.asdict(design.margins),
        "robustness": dataclasses.asdict(design.robustness),
        "findings": [one.to_document() for one in design.findings],
        "performance": dataclasses.asdict(design.performance),
        "specification": {
            **dataclasses.asdict(design.specification),
            "change": design.specification.change / design.loop.gear_ratio,
        },
        "reference": {
            "max_velocity": design.reference.max_velocity / design.loop.gear_ratio,
            "max_acceleration": design.reference.max_acceleration / design.loop.gear_ratio,
            "transition_time": design.reference.transition_time,
            "lag": design.reference.lag,
            "doubt": design.reference.doubt,
            "top_speed": design.reference.drive.top_speed / design.loop.gear_ratio,
        },
        "loop": {**dataclasses.asdict(design.loop), "delay": design.loop.loop_delay},
        "motor": dict(design.motor),
        "sensor": dict(design.sensor),
    }
    plain: dict[str, Any] = _plain(entry)
    return plain


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def to_json(document: Mapping[str, Any]) -> str:
    """Return a document as text."""
    return json.dumps(document, indent=2, allow_nan=False) + "\n"
