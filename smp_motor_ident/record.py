# SPDX-License-Identifier: Apache-2.0
"""Define the record: the validated signals of one motor, the common input of this package.

All quantities are at the motor shaft, before the gearbox; time is in seconds from the
start of the record.  Records know no files, no topics and no ROS.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any

import msgspec
import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.errors import SignalError
from smp_motor_ident.finding import Finding

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
"""Properties checked when read from a file."""


@dataclass(frozen=True)
class Hardware:
    """Gearbox, encoder and supply as described by the recording or the user.

    Attributes
    ----------
    gear_ratio : float
        Motor revolutions per wheel revolution.
    counts_per_revolution : float or None
        Encoder counts per motor revolution; None where counts are not known.
    encoder_bits : int
        Width of the hardware's counter; 0 never wraps.  Record counts are unwrapped.
    supply_voltage : float or None
        [V].
    resistance : float or None
        Armature resistance [ohm] as measured with an ohmmeter.
    current_accuracy : float or None
        Relative standard deviation of the scale of the current's sensor.
    voltage_accuracy : float or None
        Relative standard deviation of the recorded voltage against that at the terminals.
    timing_accuracy : float or None
        Standard deviation [s] between the stamp of a row and its readings.
    """

    gear_ratio: Positive = 1.0
    counts_per_revolution: Positive | None = None
    encoder_bits: Annotated[int, msgspec.Meta(ge=0, le=64)] = 0
    supply_voltage: Positive | None = None
    resistance: Positive | None = None
    current_accuracy: NotNegative | None = None
    voltage_accuracy: NotNegative | None = None
    timing_accuracy: NotNegative | None = None


@dataclass(frozen=True, eq=False)
class Record:
    """One motor's signals at the motor shaft on one time axis.

    Attributes
    ----------
    wheel : str
        Name of the wheel, such as ``front_left``.
    time : ndarray, shape (n,), [s]
        Strictly increasing sampling instants from the record's start.
    voltage : ndarray, shape (n,), [V]
        ``voltage[k]`` is the mean armature voltage over ``(time[k-1], time[k]]``.
    current : ndarray, shape (n,), [A], or None
        Armature current at the sampling instants; NaN at instants where it was lost.
    velocity : ndarray, shape (n,), [rad/s], or None
        Motor speed as the hardware reports it; NaN where lost, which infinite values become, too.
    position : ndarray, shape (n,), [rad], or None
        Motor angle; NaN where lost.
    count : ndarray of int64, shape (n,), or None
        Unwrapped encoder counts at the motor shaft.
    starts : tuple of int
        Index at which each segment begins; the first is 0.  The motion between two segments (a gap,
        a reset counter) is unknown, so each has its own initial state.
    hardware : Hardware
        Gearbox, encoder and supply.
    source : str
        Name of the bag or file.
    findings : tuple of Finding
        Repairs, assumptions and losses while reading.
    velocity_window : float
        Length [s] of the trailing window over which ``velocity`` is known to be averaged;
        0 where it is instantaneous or unknown.
    recorded : float or None
        Start of the recording [s since 1970] by its own stamps; None if unknown.

    Raises
    ------
    SignalError
        When shapes differ, time does not increase, voltage is not finite, or no output
        (velocity, position or count) is given.
    """

    wheel: str
    time: Array
    voltage: Array
    current: Array | None = None
    velocity: Array | None = None
    position: Array | None = None
    count: Integers | None = None
    starts: tuple[int, ...] = (0,)
    hardware: Hardware = field(default_factory=Hardware)
    source: str = ""
    findings: tuple[Finding, ...] = ()
    velocity_window: float = 0.0
    recorded: float | None = None

    def __post_init__(self) -> None:
        where = f"{self.source or 'record'}: {self.wheel}"
        time = np.ascontiguousarray(self.time, dtype=np.float64)
        if time.ndim != 1 or time.size < 2:
            raise SignalError(f"{where}: needs at least 2 samples, has {time.size}")
        steps = np.diff(time)
        if not np.all(np.isfinite(time)) or not np.all(steps > 0):
            k = int(np.argmin(steps > 0)) + 1
            raise SignalError(f"{where}: time does not increase at sample {k} (t = {time[k]} s)")
        object.__setattr__(self, "time", time)
        for name in ("voltage", "current", "velocity", "position"):
            values = getattr(self, name)
            if values is None:
                continue
            values = np.ascontiguousarray(values, dtype=np.float64)
            if values.shape != time.shape:
                raise SignalError(f"{where}: {name} has {values.size} samples, time {time.size}")
            if name != "voltage" and np.isinf(values).any():
                values = np.where(np.isinf(values), np.nan, values)
            object.__setattr__(self, name, values)
        if not np.all(np.isfinite(self.voltage)):
            k = int(np.argmin(np.isfinite(self.voltage)))
            raise SignalError(
                f"{where}: voltage is {self.voltage[k]} at t = {time[k]} s; it must be finite"
            )
        if self.count is not None:
            count = np.ascontiguousarray(self.count, dtype=np.int64)
            if count.shape != time.shape:
                raise SignalError(f"{where}: count has {count.size} samples, time {time.size}")
            object.__setattr__(self, "count", count)
        if self.velocity is None and self.position is None and self.count is None:
            raise SignalError(f"{where}: has neither velocity, position nor encoder counts")
        if self.starts[:1] != (0,) or any(b <= a for a, b in zip(self.starts, self.starts[1:])):
            raise SignalError(f"{where}: segment starts {self.starts} must increase from 0")

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.time.size)

    @property
    def duration(self) -> float:
        """Length of the record [s]."""
        return float(self.time[-1] - self.time[0])

    @cached_property
    def sample_time(self) -> float:
        """Median sampling interval [s]."""
        return float(np.median(np.diff(self.time)))

    def slice(self, begin: int, end: int) -> Record:
        """Return the samples ``begin`` to ``end`` (exclusive) as a record that starts at time 0."""
        part = self.take(np.arange(len(self))[begin:end])
        return replace(part, time=part.time - part.time[0])

    def take(self, rows: Integers) -> Record:
        """Return the given rows in order; a new segment begins behind missing ones."""
        starts = {0, *(np.flatnonzero(np.diff(rows) > 1) + 1), *np.searchsorted(rows, self.starts)}
        names = ("time", "voltage", "current", "velocity", "position", "count")
        arrays: dict[str, Any] = {
            name: values[rows] for name in names if (values := getattr(self, name)) is not None
        }
        starts_in_order = tuple(int(s) for s in sorted(starts) if s < rows.size)
        return replace(self, starts=starts_in_order, **arrays)
