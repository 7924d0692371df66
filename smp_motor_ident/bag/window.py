# SPDX-License-Identifier: Apache-2.0
"""Window of a running motor's recent samples, read like a bag."""

from collections import deque
from typing import Any

import numpy as np

from smp_motor_control.motor.parameters import SUPPLY_RANGE_V
from smp_motor_ident.bag.assemble import assemble
from smp_motor_ident.bag.mapping import MotorMap, Signal
from smp_motor_ident.bag.read import OWN_FIELDS
from smp_motor_ident.bag.storage import Table
from smp_motor_ident.record import Hardware, Record

MAX_SAMPLES = 200_000  # largest number of samples
MIN_SAMPLES = 10  # samples below which there is no record


class Window:
    """The last seconds of one wheel's ``motor_state``, as a record at the motor shaft."""

    def __init__(self, wheel: str, length: float) -> None:
        self.wheel = wheel
        self.hardware = Hardware()
        self._length = round(1e9 * length)
        self._rows: deque[tuple[Any, ...]] = deque(maxlen=MAX_SAMPLES)

    def __len__(self) -> int:
        """Return the number of samples held."""
        return len(self._rows)

    @property
    def last(self) -> int:
        """Stamp of the last sample [ns], 0 without one."""
        return self._rows[-1][0] if self._rows else 0

    def add(self, stamp: int, state: Any, number: int = 0) -> None:
        """Add one ``motor_state`` with its publisher's number, 0 if unknown.

        A stamp [ns] that was set back clears the window.
        """
        if not abs(state.voltage) <= SUPPLY_RANGE_V[1]:
            return
        rows = self._rows
        if rows and stamp <= rows[-1][0]:
            if stamp > rows[-1][0] - self._length:
                return  # late or twice
            rows.clear()  # the clock was set back
        rows.append((stamp, number, *(getattr(state, name) for name in OWN_FIELDS.values())))
        while rows[0][0] < stamp - self._length:
            rows.popleft()

    def record(self) -> Record | None:
        """Return the window as a record, checked like a bag; None below 10 samples."""
        if len(self) < MIN_SAMPLES:
            return None
        time, numbers, *values = map(np.array, zip(*self._rows, strict=True))
        columns = dict(zip(OWN_FIELDS.values(), values))
        signals = {name: Signal("", path) for name, path in OWN_FIELDS.items()}
        if self.hardware.counts_per_revolution is None or not np.ptp(columns["encoder_count"]):
            del signals["count"]
        bits = {"encoder_bits": self.hardware.encoder_bits}
        plan = MotorMap(signals, bits, held="before", clock="header", own=True)
        known = bool(numbers.all() and np.all(np.diff(numbers) > 0))
        table = Table(time, time, columns, number=numbers if known else None)
        return assemble(self.wheel, plan, self.hardware, {"": table}, "live")
