# SPDX-License-Identifier: Apache-2.0
"""Exclusive ownership of a wheel by the node that commands it."""

import math

from smp_motor_control.wheel.freshness import FeedbackClock, Verdict

MAX_LEASE_S = 1.0  # maximum duration of a lease

MAX_WRITERS = 64  # maximum number of writers whose clocks and refusals are stored

OTHER_WRITERS = "others"  # name under which refused commands of further writers are counted


class Lease:
    """Decide which writer's commands a wheel obeys.

    A non-zero command takes a free wheel or renews its owner's lease.  Zero commands renew nothing,
    so the lease ends ``timeout`` after the last non-zero one; until then other writers are refused.
    A non-zero command that is older than ``timeout`` by its stamp, as from the queue of a delayed
    driver, is refused.
    """

    def __init__(self, timeout: float) -> None:
        self.set_timeout(timeout)
        self.refused: dict[str, int] = {}  # number of refused commands by writer
        self.late = 0  # number of late commands
        self._owner = ""
        self._until = -math.inf
        self._clocks: dict[str, FeedbackClock] = {}

    def set_timeout(self, timeout: float) -> None:
        """Set the age at which commands expire [s]."""
        self.timeout, self._expire = min(timeout, MAX_LEASE_S), timeout
        self._clocks = {}

    def take(
        self, writer: str, voltage: float, now: float, stamp: int = 0, arrival: int = 0
    ) -> bool:
        """Return whether a command is obeyed, given its arrival on a steady clock [s].

        ``stamp`` and ``arrival`` are on the stamp's clock [ns]; a stamp of 0 means none.
        """
        late = self._is_late(writer, now, stamp, arrival)
        if writer != self._owner and now < self._until:
            known = writer in self.refused or len(self.refused) < MAX_WRITERS
            name = writer if known else OTHER_WRITERS
            self.refused[name] = self.refused.get(name, 0) + 1
            return False
        if late and voltage != 0.0:
            self.late += 1
            return False
        if voltage != 0.0 and math.isfinite(voltage):
            self._owner, self._until = writer, now + self.timeout
        return True

    def _is_late(self, writer: str, now: float, stamp: int, arrival: int) -> bool:
        clocks = self._clocks
        clock = clocks.pop(writer, None) or FeedbackClock(self._expire, math.inf)
        clocks[writer] = clock  # newest last
        if len(clocks) > MAX_WRITERS:
            del clocks[next(iter(clocks))]
        return clock.accept(stamp, arrival, now) is Verdict.LATE

    def owner(self, now: float) -> str:
        """Return the owner of the wheel; empty without an owner or for one without a name."""
        return self._owner if now < self._until else ""
