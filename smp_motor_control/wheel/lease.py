"""Who may drive a wheel: the writer that drove it last, until it has rested for a while."""

from __future__ import annotations

import math

LONGEST = 1.0
"""Of a lease whose wheel's commands never expire [s]."""


class Lease:
    """Decides whose commands a wheel obeys.

    Every command other than 0 V takes the wheel, where it is free, or renews the lease of its
    owner.  Zero commands renew nothing, so that a writer which rests, ends or dies gives the
    wheel back by itself after ``timeout``; until then all others are refused.

    Attributes
    ----------
    refused : dict of str to int
        How many commands of each writer were refused.

    Examples
    --------
    >>> lease = Lease(0.2)
    >>> lease.take("excite", 3.0, now=0.0), lease.take("wheel_pid", 1.0, now=0.1)
    (True, False)
    >>> lease.take("excite", 0.0, now=0.1), lease.take("wheel_pid", 1.0, now=0.21)
    (True, True)
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = min(timeout, LONGEST)
        self.refused: dict[str, int] = {}
        self._owner = ""
        self._until = -math.inf

    def take(self, writer: str, voltage: float, now: float) -> bool:
        """Judge a command."""
        if writer != self._owner and now < self._until:
            self.refused[writer] = self.refused.get(writer, 0) + 1
            return False
        if voltage != 0.0 and math.isfinite(voltage):
            self._owner, self._until = writer, now + self.timeout
        return True

    def owner(self, now: float) -> str:
        """Return who owns the wheel; empty where nobody does, or nobody that says its name."""
        return self._owner if now < self._until else ""
