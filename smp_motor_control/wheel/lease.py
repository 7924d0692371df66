"""Who may drive a wheel: the writer that drove it last, until it has rested for a while."""

import math

from smp_motor_control.wheel.freshness import FeedbackClock, Verdict

LONGEST = 1.0
"""Of a lease whose wheel's commands never expire [s]."""

MOST_WRITERS = 64
"""That are known at a time, by their clocks and their refusals; more are no robot's."""

OTHERS = "others"
"""Under which refused commands of still more writers are counted."""


class Lease:
    """Decides whose commands a wheel obeys.

    Every command other than 0 V takes the wheel, where it is free, or renews the lease of its
    owner.  Zero commands renew nothing, so that a writer which rests, ends or dies gives the
    wheel back by itself after ``timeout``; until then all others are refused.  A command that is
    late by ``timeout``, by its stamp, was meant for another moment: it is refused unless it is 0 V.
    Drivers that stood still find such in their queues.

    Examples
    --------
    >>> lease = Lease(0.2)
    >>> lease.take("excite", 3.0, now=0.0), lease.take("wheel_pid", 1.0, now=0.1)
    (True, False)
    >>> lease.take("excite", 0.0, now=0.1), lease.take("wheel_pid", 1.0, now=0.21)
    (True, True)
    """

    def __init__(self, timeout: float) -> None:
        self.set_timeout(timeout)
        self.refused: dict[str, int] = {}  # how many commands of each writer were refused
        self.late = 0  # how many commands came late
        self._owner = ""
        self._until = -math.inf
        self._clocks: dict[str, FeedbackClock] = {}

    def set_timeout(self, timeout: float) -> None:
        """Set the age at which commands expire [s]."""
        self.timeout, self._expire = min(timeout, LONGEST), timeout
        self._clocks = {}

    def take(
        self, writer: str, voltage: float, now: float, stamp: int = 0, arrival: int = 0
    ) -> bool:
        """Judge a command by its writer, its arrival on a steady clock [s], and its stamp [ns].

        ``arrival`` is read from the stamp's clock [ns]; a stamp of 0 tells nothing.
        """
        late = self._is_late(writer, now, stamp, arrival)
        if writer != self._owner and now < self._until:
            known = writer in self.refused or len(self.refused) < MOST_WRITERS
            name = writer if known else OTHERS
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
        clocks[writer] = clock  # the last one to be forgotten
        if len(clocks) > MOST_WRITERS:
            del clocks[next(iter(clocks))]
        return clock.accept(stamp, arrival, now) is Verdict.LATE

    def owner(self, now: float) -> str:
        """Return who owns the wheel; empty where nobody does, or nobody that says its name."""
        return self._owner if now < self._until else ""
