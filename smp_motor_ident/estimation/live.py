"""Whether a running motor's recent past shows enough to identify the motor from."""

from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.record import Record


@dataclass(frozen=True)
class Demands:
    """What a window must have seen before an estimate is made of it."""

    duration: float = 5.0  # seconds of data
    moving: float = 3.0  # seconds in which the motor turned
    # bins, filled: the range of voltages that occurred is cut into `bins`; `filled` of them must
    # hold at least 2 % of the samples each
    bins: int = 8
    filled: int = 3
    changes: int = 6  # how often the voltage must have crossed its mean
    both_directions: bool = True  # whether the motor must have turned forward and backward


def missing(record: Record | None, demands: Demands) -> list[str]:
    """Return what the record lacks, in words; empty where an estimate may be made."""
    if record is None:
        return ["no motor_state yet"]
    voltage, speed = record.voltage, _speed(record)
    step = record.sample_time
    threshold = 0.02 * max(float(np.nanmax(np.abs(speed))), 1e-9)
    forward, backward = float(np.mean(speed > threshold)), float(np.mean(speed < -threshold))
    moving = (forward + backward) * speed.size * step
    shares = np.histogram(voltage, demands.bins)[0] / voltage.size
    filled = int(np.sum(shares >= 0.02)) if np.ptp(voltage) > 0 else 1
    above = voltage > voltage.mean()
    changes = int(np.sum(above[1:] != above[:-1]))
    checks: list[tuple[bool, str]] = [
        (record.duration >= demands.duration, f"{record.duration:.1f} of {demands.duration:g} s"),
        (moving >= demands.moving, f"turned for {moving:.1f} of {demands.moving:g} s"),
        (filled >= demands.filled, f"{filled} of {demands.filled} levels of voltage"),
        (changes >= demands.changes, f"{changes} of {demands.changes} changes of voltage"),
        (
            not demands.both_directions or min(forward, backward) > 0.1,
            f"forward {100 * forward:.0f} %, backward {100 * backward:.0f} % of the time, "
            "10 % each are needed",
        ),
    ]
    return [text for met, text in checks if not met]


def _speed(record: Record) -> Array:
    """Return the motor's speed, from counts where they are known."""
    per_turn = record.hardware.counts_per_revolution
    if record.count is not None and per_turn:
        speed: Array = np.gradient(record.count * (2 * np.pi / per_turn), record.time)
        return speed
    assert record.velocity is not None
    return record.velocity
