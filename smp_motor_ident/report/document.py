# SPDX-License-Identifier: Apache-2.0
"""Write and read estimates: ``identification.json`` and ``motors.yaml``, all files or none."""

import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from smp_motor_control.errors import is_ros_name, printable
from smp_motor_control.motor.parameters import COMBINATIONS, PHYSICAL
from smp_motor_control.parameter_file import format_parameters
from smp_motor_ident.errors import BagError, ParameterError
from smp_motor_ident.report.words import date
from smp_motor_ident.result import Estimate, Quantity

SCHEMA = 1
MAX_VALUE = 1e12
"""Largest accepted value in SI units; squares of larger ones overflow."""
Rows = list[list[float]]
POSITIVE_QUANTITIES = ("resistance", "inductance", "motor_constant", "inertia", "dc_gain")


def now() -> str:
    """Return the present time as written in files."""
    return date(time.time())


def identification_document(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """Return the content of ``identification.json``."""
    motors = {wheel: estimate.to_document() for wheel, estimate in estimates.items()}
    return {"schema": SCHEMA, "motors": motors}


def read_identification(path: Path) -> dict[str, Estimate]:
    """Read ``identification.json``."""
    if path.is_dir():
        path = path / "identification.json"
    if path.exists() and not path.is_file():
        raise BagError(f"{path}: is not a file; give a file that identify wrote")
    try:
        document = _escape_texts(msgspec.json.decode(path.read_bytes()))
    except OSError as error:
        raise BagError(f"{path}: cannot be read ({error.strerror})") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BagError(f"{path}: is not JSON ({error}); give a file that identify wrote") from None
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise BagError(f"{path}: is not an identification of schema {SCHEMA}; run identify again")
    motors = document.get("motors")
    if not isinstance(motors, dict) or not motors:
        raise BagError(f"{path}: is damaged (it holds no motors); run identify again")
    for wheel in motors:
        if not is_ros_name(wheel):
            raise BagError(
                f"{path}: the wheel {wheel!r} has no ROS name; rename it: letters, digits, _"
            )
    return {wheel: _read_motor(wheel, entry, path) for wheel, entry in motors.items()}


def _escape_texts(value: Any) -> Any:
    """Return a document's contents with line breaks in its texts replaced."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, list):
        return [_escape_texts(inner) for inner in value]
    if isinstance(value, dict):
        return {key: _escape_texts(inner) for key, inner in value.items()}
    return value


def _read_motor(wheel: str, entry: Any, path: Path) -> Estimate:
    """Return one motor of a document; its values are checked against the types of Estimate."""
    try:
        given = {k: v for k, v in msgspec.convert(entry, dict[str, Any]).items() if v is not None}
        given["wheel"] = wheel
        covariance = msgspec.convert(given.pop("covariance", {}), dict[str, Any])
        if covariance.get("names"):
            given |= {"names": covariance["names"], "covariance": covariance.get("matrix", [])}
        for group in (given.get("parameters", {}), given.get("combinations", {})):
            for quantity in msgspec.convert(group, dict[str, dict[str, Any]]).values():
                quantity["ci95"] = _read_interval(quantity.get("ci95"))
        estimate = msgspec.convert(
            given, Estimate, dec_hook=lambda _, rows: np.array(msgspec.convert(rows, Rows), float)
        )
        _check_values(estimate)
        return estimate
    except (msgspec.ValidationError, ValueError) as error:
        raise BagError(f"{path}: is damaged ({wheel}: {error}); run identify again") from None


def _read_interval(bounds: Any) -> Any:
    """Return an interval with infinite ends, which are null in JSON."""
    if not isinstance(bounds, list) or len(bounds) != 2:
        return bounds
    return [end if one is None else one for one, end in zip(bounds, (-math.inf, math.inf))]


def _check_values(estimate: Estimate) -> None:
    """Raise an error for impossible values of the right type."""
    size = len(estimate.names)
    if estimate.covariance.shape != (size, size) or len(set(estimate.names)) != size:
        raise ValueError(f"the covariance is not one of its {size} names")
    if error := estimate.residuals.model_error:
        lengths = {len(error.frequency), len(error.shown), len(error.bound)}
        if len(lengths) > 1:
            raise ValueError(f"residuals.model_error has lists of {sorted(lengths)} numbers")
        rising = (0.0, *error.frequency)
        if not all(a < b for a, b in pairwise(rising)) or min(error.bound, default=1.0) < 0:
            raise ValueError("residuals.model_error: frequencies must rise, bounds be positive")
    if size and (np.diag(estimate.covariance) < 0).any():
        raise ValueError("a variance is negative")
    for name, quantity in (*estimate.parameters.items(), *estimate.combinations.items()):
        if abs(quantity.value or 0.0) > MAX_VALUE:
            raise ValueError(f"{name} is {quantity.value:g}; no motor has that")
        if quantity.value is None and quantity.status != "unidentifiable":
            raise ValueError(f"{name}: it is {quantity.status} and has no value")
        if name in POSITIVE_QUANTITIES and quantity.value is not None and quantity.value <= 0:
            raise ValueError(f"{name} is {quantity.value}; it must be positive")


def _is_known(quantity: Quantity | None) -> bool:
    return quantity is not None and quantity.value is not None and math.isfinite(quantity.value)


def motor_entry(estimate: Estimate) -> dict[str, float | int]:
    """Return the parameters with which ``motor_plant`` simulates this motor.

    They are the physical parameters if all are known, else the combinations, which give the same
    response from voltage to speed.
    """
    parameters = estimate.parameters
    physical = all(_is_known(parameters.get(name)) for name in PHYSICAL[:5])
    names = PHYSICAL if physical else COMBINATIONS
    held = parameters if physical else estimate.combinations
    entry: dict[str, float | int] = {
        name: float(estimate.value(name)) for name in names if _is_known(held.get(name))
    }
    if estimate.value("delay") > 0:
        entry["delay"] = float(estimate.value("delay"))
    hardware = estimate.hardware
    entry["gear_ratio"] = float(hardware.gear_ratio)
    if hardware.counts_per_revolution:
        entry["counts_per_revolution"] = float(hardware.counts_per_revolution)
        entry["encoder_bits"] = int(hardware.encoder_bits)
    if hardware.supply_voltage:
        entry["supply_voltage"] = float(hardware.supply_voltage)
    return entry


def motors_yaml(estimates: Mapping[str, Estimate], provenance: Iterable[str] = ()) -> str:
    """Return ``motors.yaml``: a ROS 2 parameter file that ``motor_plant`` loads as it is."""
    motors = {wheel: motor_entry(estimate) for wheel, estimate in estimates.items()}
    return format_parameters({"/**/motor_plant": {"motors": motors}}, provenance)


def check_free(paths: Iterable[Path], force: bool) -> None:
    """Refuse to overwrite, and folders that cannot be written, before anything is computed."""
    for path in paths:
        if path.is_dir():
            raise ParameterError(f"{path}: is a folder, not a file; choose another --output")
        if path.exists() and not force:
            raise ParameterError(f"{path}: exists already; use --force to replace it")
        there = next(p for p in path.absolute().parents if p.exists())
        try:
            with tempfile.TemporaryDirectory(dir=there, prefix=".writing-"):
                pass
        except OSError as error:
            raise ParameterError(f"{path.parent}: cannot be written ({error.strerror})") from None


def write_together(files: Mapping[Path, str | bytes], force: bool = False) -> None:
    """Write several files of one folder so that all of them appear, or none."""
    check_free(files, force)
    (folder,) = {path.parent for path in files}
    made = next((p for p in reversed((folder, *folder.parents)) if not p.exists()), None)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as draft:
            _exchange({Path(draft) / p.name: (p, body) for p, body in files.items()})
    except OSError as error:
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)
        raise ParameterError(f"{folder}: cannot be written ({error.strerror})") from None


def _exchange(drafts: Mapping[Path, tuple[Path, str | bytes]]) -> None:
    """Write the drafts in full, then rename them into place; undo the renames on failure."""
    for draft, (_, body) in drafts.items():
        # A path that is not UTF-8 may have put surrogates into the text
        draft.write_bytes(body.encode("utf-8", "replace") if isinstance(body, str) else body)
    done: list[tuple[Path, Path | None]] = []
    try:
        for draft, (path, _) in drafts.items():
            old = draft.with_name(draft.name + ".old") if path.exists() else None
            if old is not None:
                os.replace(path, old)
            done.append((path, old))
            os.replace(draft, path)
    except BaseException:
        for path, old in reversed(done):
            if old is not None:
                os.replace(old, path)
            else:
                path.unlink(missing_ok=True)
        raise
