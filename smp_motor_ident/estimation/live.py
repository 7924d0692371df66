"""A running motor's recent past, and whether it shows enough to identify the motor from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from smp_motor_control.encoder import unwrap
from smp_motor_control.motor.friction import Gearbox
from smp_motor_ident.record import Hardware, Record

Array = NDArray[np.float64]

FIELDS = ("time", "voltage", "current", "velocity", "position")


class Window:
    """The last seconds of one wheel's ``motor_state``, as a record at the motor shaft.

    Parameters
    ----------
    wheel : str
        Name of the wheel.
    length : float
        How much is kept [s].
    capacity : int
        How many samples are kept at most.
    """

    def __init__(self, wheel: str, length: float, capacity: int = 200_000) -> None:
        self.wheel = wheel
        self.hardware = Hardware()
        self._length = length
        self._values = np.zeros((min(capacity, 4096), len(FIELDS)))
        self._counts = np.zeros(self._values.shape[0], dtype=np.int64)
        self._capacity = capacity
        self._begin = self._end = 0

    def __len__(self) -> int:
        """Return the number of samples held."""
        return self._end - self._begin

    def add(
        self,
        time: float,
        voltage: float,
        current: float,
        velocity: float,
        position: float,
        count: int,
    ) -> None:
        """Take one sample; a time that does not increase begins the window anew."""
        if not (np.isfinite(time) and np.isfinite(voltage)):
            return
        if len(self) and time <= self._values[self._end - 1, 0]:
            if time > self._values[self._end - 1, 0] - self._length:
                return  # late or twice
            self._begin = self._end = 0  # the clock was set back
        if self._end == self._values.shape[0]:
            self._make_room()
        self._values[self._end] = (time, voltage, current, velocity, position)
        self._counts[self._end] = count
        self._end += 1
        while self._values[self._begin, 0] < time - self._length:
            self._begin += 1

    def _make_room(self) -> None:
        """Move what is held to the front, into a larger array where more than half is in use."""
        keep = slice(self._begin, self._end)
        size = self._values.shape[0]
        if len(self) > size // 2:
            size = min(2 * size, self._capacity)
        if len(self) >= size:
            keep = slice(self._end - size // 2, self._end)
        values, counts = np.zeros((size, len(FIELDS))), np.zeros(size, dtype=np.int64)
        held = keep.stop - keep.start
        values[:held], counts[:held] = self._values[keep], self._counts[keep]
        self._values, self._counts = values, counts
        self._begin, self._end = 0, held

    def record(self) -> Record | None:
        """Return what is held; None below 10 samples."""
        if len(self) < 10:
            return None
        held = self._values[self._begin : self._end].copy()
        counts = unwrap(self._counts[self._begin : self._end], self.hardware.encoder_bits)
        time = held[:, 0] - held[0, 0]
        steps = np.diff(time)
        gaps = np.flatnonzero(steps > 5 * np.median(steps)) + 1
        ratio = Gearbox(self.hardware.gear_ratio).to_motor(1.0)
        counted = self.hardware.counts_per_revolution is not None and np.ptp(counts) > 0
        return Record(
            wheel=self.wheel,
            time=time,
            voltage=held[:, 1],
            current=held[:, 2] if np.isfinite(held[:, 2]).any() else None,
            velocity=held[:, 3] * ratio,
            position=held[:, 4] * ratio if np.isfinite(held[:, 4]).any() else None,
            count=counts if counted else None,
            starts=(0, *(int(k) for k in gaps)),
            hardware=self.hardware,
            source="live",
        )


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
