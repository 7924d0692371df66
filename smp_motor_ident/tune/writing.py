# SPDX-License-Identifier: Apache-2.0
"""Write designs: the parameter file of the wheel nodes, and ``gains.json``."""

import bisect
import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.hardware import DriveSettings
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.parameter_file import format_parameters
from smp_motor_control.wheel.controller import WheelSettings
from smp_motor_control.wheel.differenced import differenced_gains
from smp_motor_control.wheel.faults import FaultLimits
from smp_motor_control.wheel.loop import LoopSettings
from smp_motor_control.wheel.stop import MAX_STOP_TIME_S
from smp_motor_ident.limits import MIN_OUTLIER_DEVIATIONS
from smp_motor_ident.result import plain
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.loop import Loop

SCHEMA = 1

STOP_TIME_FACTOR = 1.25
"""Safety factor on the computed time of a stop from full speed."""


def parameters(design: Design) -> dict[str, Any]:
    """Return the parameters of one wheel's ``wheel_pid`` node."""
    gains = dataclasses.asdict(design.gains)
    gains.pop("error_deadband")
    reference = design.wheel_reference
    limit, start = reference.max_acceleration, design.breakaway
    return {
        **gains,
        "max_velocity": float(reference.max_velocity),
        "max_acceleration": float(limit) if math.isfinite(limit) else 0.0,
        "transition_time": float(reference.transition_time),
        "reference_delay": float(reference.lag),
        "reference_delay_uncertainty": float(reference.doubt),
        "drive": {n: float(x) for n, x in dataclasses.asdict(reference.drive).items()},
        "speed_source": str(design.loop.speed_source),
        "difference_window": _choose_window(design),
        "model": {name: float(value) for name, value in design.motor.items()},
        **_widen_plausibility(reference.drive.top_speed, design.loop),
        # Voltage above which a standing wheel is a fault, if the default is too low
        **({"stall_voltage": start} if start > FaultLimits().stall_voltage else {}),
        **_extend_time_outs(design),
    }


def _extend_time_outs(design: Design) -> dict[str, float]:
    """Return the times of the stop rule and of lost feedback where the usual ones are too short."""
    reference, times = design.wheel_reference, {}
    profile, sample_time = reference.profile(), design.loop.sample_time
    profile.reset(float(reference.max_velocity))
    profile.set_target(0.0, sample_time)
    stop = STOP_TIME_FACTOR * (profile.duration + reference.lag + reference.doubt)
    if stop > MAX_STOP_TIME_S:
        raise ParameterError(
            f"sampled every {sample_time:.3g} s, a wheel would stop {stop:.3g} s after a set-point "
            f"of zero; wheel_pid accepts at most {MAX_STOP_TIME_S:g} s. Sample it faster"
        )
    if stop > LoopSettings().stop_time:
        times["stop_time"] = stop
    if silence(design.loop) > WheelSettings().feedback_timeout:
        times["feedback_timeout"] = silence(design.loop)
    return times


def silence(loop: Loop) -> float:
    """Return the silence that a loop must tolerate: two lost samples and a late one [s]."""
    return 3.5 * loop.sample_time


def describe_slow_loop(design: Design) -> list[str]:
    """Return required settings of the hardware's driver for a loop with a low rate."""
    needed, interval = silence(design.loop), design.loop.sample_time
    if needed <= DriveSettings().command_timeout:
        return []
    return [
        f"a command comes every {interval:.3g} s: the hardware's driver must hold it for "
        f"{needed:.3g} s (command_timeout), or the wheel falls back to 0 V between two commands"
    ]


def _choose_window(design: Design) -> int:
    """Return the samples to difference counts over.

    Differenced counts replace an observer that contradicts them.  The window is the shortest in
    which one count causes at most the allowed control noise, with the gains for that window.
    """
    loop, motor = design.loop, MotorModel(**design.motor)
    if loop.speed_source != "observer" or loop.averaging_given:
        return int(max(loop.difference_window, 1))
    quantum = loop.count_angle / loop.gear_ratio

    def quiet(window: int) -> bool:
        span = window * loop.sample_time
        gains = differenced_gains(design.gains, motor, loop.gear_ratio, 0.5 * span, window)
        return gains.p * quantum <= loop.noise_limit * span

    return bisect.bisect_left(range(1000), True, lo=1, key=quiet)


def _widen_plausibility(top_speed: float, loop: Loop) -> dict[str, float]:
    """Return the limits of plausible feedback that differ from the defaults."""
    limits, usual = {}, WheelSettings().implausible_velocity
    if 2 * top_speed > usual:
        limits["implausible_velocity"] = 2 * top_speed
    if loop.reported_noise:
        limits["implausible_jump"] = MIN_OUTLIER_DEVIATIONS * loop.reported_noise / loop.gear_ratio
    return limits


def gains_yaml(designs: Mapping[str, Design], provenance: Iterable[str]) -> str:
    """Return the parameter file of all wheel nodes."""
    nodes = {f"/**/{wheel}/wheel_pid": parameters(design) for wheel, design in designs.items()}
    return format_parameters(nodes, provenance)


def gains_document(
    designs: Mapping[str, Design], provenance: Mapping[str, Any], reason: str
) -> dict[str, Any]:
    """Return the content of ``gains.json``."""
    return {
        "schema": SCHEMA,
        "provenance": dict(provenance),
        "reason": reason,
        "wheels": {wheel: _write_design(design) for wheel, design in designs.items()},
    }


def _write_design(design: Design) -> dict[str, Any]:
    bands, reference = design.specification, dataclasses.asdict(design.wheel_reference)
    drive = reference.pop("drive")
    entry = {name: getattr(design, name) for name in _WRITTEN}
    change = bands.change / design.loop.gear_ratio
    entry["specification"] = dataclasses.replace(bands, change=change)
    entry["reference"] = {**reference, "top_speed": drive["top_speed"]}
    entry["loop"] = dataclasses.replace(design.loop, delay=design.loop.loop_delay)
    return dict(plain(entry))


_WRITTEN = (
    "method", "reason", "warnings", "gains", "margins", "robustness", "findings", "performance",
    "specification", "settling", "reference", "loop", "motor", "sensor",
)  # fmt: skip
"""Fields of a design in ``gains.json``; wheel quantities at the wheel."""
