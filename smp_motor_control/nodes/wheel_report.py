# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of ``wheel_pid``."""

import gc
from collections.abc import Mapping
from typing import Any

from rclpy.node import Node

from smp_interfaces.msg import PidState
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.publishers import PublisherWatch, describe_two_publishers
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.controller import State, WheelController
from smp_motor_control.wheel.freshness import Verdict

_LEVELS = {
    State.WAITING: runtime.OK,
    State.DRIVING: runtime.OK,
    State.INACTIVE: runtime.OK,
    State.TIMED_OUT: runtime.WARN,
    State.OWNED_ELSEWHERE: runtime.WARN,
    State.ROLLING: runtime.WARN,
}
_TERMS = ("p_term", "i_term", "d_term", "feedforward", "unsaturated")
UNTUNED_TEXT = (
    "default gains: p is 1 V s/rad, i and d are 0, which suit no particular motor; start it with "
    "--params-file gains.yaml, which tune writes"
)


UNSTAMPED_TEXT = (
    "motor_state has no stamp, so its delay is unknown; the driver must set the time of sampling"
)


def has_default_gains(gains: PidGains) -> bool:
    """Return whether the gains are the defaults."""
    return (gains.p, gains.i, gains.d) == (PidGains().p, PidGains().i, PidGains().d)


class WheelReport:
    """Assess one wheel for ``/diagnostics`` every second and on state changes."""

    def __init__(
        self,
        node: Node,
        wheel: WheelController,
        joint: str,
        watches: Mapping[str, PublisherWatch] | None = None,
    ) -> None:
        self.timekeeping: list[str] = []
        self._wheel, self._node, self._watches = wheel, node, watches or {}
        self._reported: dict[str, int] = {}
        self.shown: State | None = None
        self._log = node.get_logger()
        self._diagnostics = runtime.Diagnostics(node, self._assess, joint)
        if has_default_gains(wheel.settings.loop.gains):
            self._log.warning(UNTUNED_TEXT)

    def close(self) -> None:
        self._diagnostics.destroy()

    def update(self) -> None:
        """Publish at once after a change of state."""
        if self._wheel.state is not self.shown:
            self.shown = self._wheel.state
            if self.shown is State.FAULT:
                self._log.error(f"{self._describe_state()[1]}; 0 V")
            self._diagnostics.publish()

    def _totals(self) -> dict[str, int]:
        """Return the number of irregular events since the start, by kind."""
        clock = self._wheel.clock
        usual = (Verdict.FRESH, Verdict.FIRST)
        totals = {v.value: n for v, n in clock.counts.items() if v not in usual}
        return {**totals, "clock jumps": clock.jumps, **self._wheel.refused}

    def _describe_state(self) -> tuple[bytes, str]:
        wheel = self._wheel
        fault = wheel.recovery.fault
        if fault is not None and wheel.state is not State.INACTIVE:
            ending = "; latched: call ~/reset" if wheel.recovery.latched else ""
            return runtime.ERROR, fault.value + ending
        more = f" ({wheel.owner})" if wheel.state is State.OWNED_ELSEWHERE else ""
        if wheel.state is State.NO_FEEDBACK and wheel.clock.gap:
            more = (
                f"; motor_state came {wheel.clock.gap:.3g} s after the previous one, and "
                f"feedback_timeout is {wheel.settings.feedback_timeout:g} s: raise it for "
                "such slow feedback"
            )
        return _LEVELS.get(wheel.state, runtime.ERROR), wheel.state.value + more

    def _describe_oscillation(self) -> str:
        """Return the message about an oscillation around the set-point; else nothing."""
        wheel, found = self._wheel, self._wheel.oscillation.found
        if found is None or wheel.state is not State.DRIVING:
            return ""
        rate = 1.0 / wheel.clock.dt if wheel.clock.dt else 0.0
        return (
            f"the speed oscillates by {found.amplitude:.2g} rad/s around {wheel.target:.2g} rad/s "
            f"at {found.frequency:.2g} Hz: the gains are too high for feedback at {rate:.0f} Hz; "
            f"halve p, i and d, or design them with tune --rate {rate:.0f}"
        )

    def _describe_overload(self) -> str:
        """Return the message about a wheel under overload; else nothing."""
        overload = self._wheel.overload
        if overload is None:
            return ""
        return (
            f"the wheel gets {overload[0]:.2g} V for {abs(self._wheel.measurement):.2g} rad/s and "
            f"should need {overload[1]:.2g} V: a heavy load, or an encoder that loses counts; "
            "check both before the motor overheats"
        )

    def _assess(self) -> tuple[bytes, str, Mapping[str, object]]:
        level, message = self._describe_state()
        totals = self._totals()
        recent = {key: n - self._reported.get(key, 0) for key, n in totals.items()}
        listed = ", ".join(f"{n} x {key}" for key, n in recent.items() if n)
        if listed:
            message = f"{message}; in the last second: {listed}"
            level = max(level, runtime.WARN)
        wheel, clock = self._wheel, self._wheel.clock
        warnings = (
            wheel.advice,
            self._describe_oscillation(),
            self._describe_overload(),
            wheel.loop.wraps_at
            and f"encoder_count wraps at {wheel.loop.wraps_at} bits, unlike motor_description: "
            "correct its encoder_bits",
            *(describe_two_publishers(self._node, topic) for topic, one in self._watches.items()
              if one.has_two_publishers),
            clock.unstamped and UNSTAMPED_TEXT,
        )  # fmt: skip
        advice = [text for text in warnings if text]
        if advice:
            level = max(level, runtime.WARN)
        if has_default_gains(wheel.settings.loop.gains):
            advice.append(UNTUNED_TEXT)
        if self._diagnostics.due:
            self._reported = totals
            gc.collect()
        values: dict[str, object] = {
            "steps": wheel.steps,
            "set-point [rad/s]": "none" if wheel.setpoint is None else wheel.setpoint,
            "output [V]": wheel.output,
            "speed source": wheel.loop.source,
            "feedback dt [s]": clock.dt,
            "feedback age [s]": clock.age,
            "offset of the feedback's clock [s]": clock.offset,
            "faults since the wheel was sound": wheel.recovery.failures,
        }
        return level, "; ".join([message, *self.timekeeping, *advice]), {**values, **totals}


def pid_state(wheel: WheelController, joint: str, stamp: Any) -> PidState:
    """Return the controller's last step as a message."""
    out, reference = wheel.answer, wheel.loop.reference.velocity
    state = PidState(
        setpoint=wheel.target,
        reference=reference,
        measurement=wheel.measurement,
        error=reference - wheel.measurement,
        **{name: getattr(out, name) for name in _TERMS},
        output=wheel.output,
        saturated=wheel.output != out.unsaturated,
        dt=wheel.clock.dt,
        age=wheel.clock.age,
    )
    state.header.stamp, state.header.frame_id = stamp, joint
    return state
