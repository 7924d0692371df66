"""What ``wheel_pid`` tells of its health: its state, and everything out of the ordinary."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rclpy.node import Node

from smp_motor_control.nodes import runtime
from smp_motor_control.wheel.supervision import FeedbackClock, Latch, Verdict

WAITING = "waiting for a set-point"
DRIVING = "driving"
TIMED_OUT = "set-point timed out: braked, then 0 V"
NO_FEEDBACK = "no feedback: 0 V"
LATE_FEEDBACK = "feedback is late: 0 V"
BAD_FEEDBACK = "feedback is not a number or implausible: left out"
INACTIVE = "not active"

_LEVELS = {
    WAITING: runtime.OK,
    DRIVING: runtime.OK,
    INACTIVE: runtime.OK,
    TIMED_OUT: runtime.WARN,
    NO_FEEDBACK: runtime.ERROR,
    LATE_FEEDBACK: runtime.ERROR,
    BAD_FEEDBACK: runtime.ERROR,
}


class WheelReport:
    """Keeps state and counts of one wheel, and assesses them for ``/diagnostics``.

    Parameters
    ----------
    feedback : FeedbackClock
        Counts late, duplicated and reordered feedback.
    latch : Latch
        Holds the fault.
    values : callable
        Returns further values to tell.

    Attributes
    ----------
    state : str
        One of this module's, or the name of a fault.
    timekeeping : list of str
        What the system refused.
    """

    def __init__(
        self, feedback: FeedbackClock, latch: Latch, values: Callable[[], dict[str, object]]
    ) -> None:
        self.state = INACTIVE
        self.timekeeping: list[str] = []
        self._feedback, self._latch, self._values = feedback, latch, values
        self._refused: dict[str, int] = {}
        self._reported: dict[str, int] = {}
        self._diagnostics: runtime.Diagnostics | None = None

    def open(self, node: Node, joint: str) -> None:
        """Begin to publish.

        Parameters
        ----------
        node : rclpy.node.Node
            Owner of the topic.
        joint : str
            Name of the hardware.
        """
        self._diagnostics = runtime.Diagnostics(node, self._assess, joint)

    def close(self) -> None:
        """Fall silent."""
        if self._diagnostics is not None:
            self._diagnostics.destroy()
            self._diagnostics = None

    def enter(self, state: str) -> None:
        """Be in a state from now on, and tell at once if it is a new one."""
        if state is not self.state:
            self.state = state
            if self._diagnostics is not None:
                self._diagnostics.publish()

    def enter_silence(self) -> None:
        """Be without usable feedback: late, refused, or none at all."""
        recent = self._recent()
        if self.state is LATE_FEEDBACK and recent.get(Verdict.LATE.value, 0) > 0:
            return
        refused = any(n > 0 for what, n in recent.items() if what.startswith("feedback"))
        self.enter(BAD_FEEDBACK if refused else NO_FEEDBACK)

    def refuse(self, what: str) -> None:
        """Count something that was left out."""
        self._refused[what] = self._refused.get(what, 0) + 1

    def _totals(self) -> dict[str, int]:
        """Return how often each thing out of the ordinary has happened since the start."""
        counts = self._feedback.counts
        usual = (Verdict.FRESH, Verdict.FIRST)
        totals = {v.value: n for v, n in counts.items() if v not in usual}
        return {**totals, "clock jumps": self._feedback.jumps, **self._refused}

    def _recent(self) -> dict[str, int]:
        """Return the same since the last second's diagnostics."""
        return {key: n - self._reported.get(key, 0) for key, n in self._totals().items()}

    def _assess(self) -> tuple[bytes, str, Mapping[str, object]]:
        message = self._latch.fault.value if self._latch.fault else self.state
        level = _LEVELS.get(message, runtime.ERROR)
        recent = {key: n for key, n in self._recent().items() if n}
        if recent:
            told = ", ".join(f"{n} x {key}" for key, n in recent.items())
            message = f"{message}; in the last second: {told}"
            level = max(level, runtime.WARN)
        message = "; ".join([message, *self.timekeeping])
        totals = self._totals()
        if self._diagnostics is not None and self._diagnostics.due:
            self._reported = totals
            runtime.collect_garbage()
        return level, message, {**self._values(), **totals}
