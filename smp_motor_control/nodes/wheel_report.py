"""What ``wheel_pid`` says of its health: its state, and everything out of the ordinary."""

import gc
from collections.abc import Mapping
from typing import Any

from rclpy.node import Node

from smp_interfaces.msg import PidState
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.publishers import PublisherWatch, two_publishers
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.controller import State, WheelController
from smp_motor_control.wheel.freshness import Verdict

_LEVELS = {
    State.WAITING: runtime.OK,
    State.DRIVING: runtime.OK,
    State.INACTIVE: runtime.OK,
    State.TIMED_OUT: runtime.WARN,
    State.NOT_OURS: runtime.WARN,
    State.ROLLING: runtime.WARN,
}
_TERMS = ("p_term", "i_term", "d_term", "feedforward", "unsaturated")
UNTUNED = (
    "no gains were given: p is 1 V s/rad, i and d are 0, made for no motor; start it with "
    "--params-file gains.yaml, which tune writes"
)


UNSTAMPED = (
    "motor_state has no stamp: its arrival counts, and its delay is not seen; the driver must fill "
    "in the instant of sampling"
)


def untuned(gains: PidGains) -> bool:
    """Return whether nobody has given gains."""
    return (gains.p, gains.i, gains.d) == (PidGains().p, PidGains().i, PidGains().d)


class WheelReport:
    """Assesses one wheel for ``/diagnostics``, every second and on every change of its state."""

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
        if untuned(wheel.settings.loop.gains):
            self._log.warning(UNTUNED)

    def close(self) -> None:
        self._diagnostics.destroy()

    def update(self) -> None:
        """Publish at once where the state is a new one."""
        if self._wheel.state is not self.shown:
            self.shown = self._wheel.state
            if self.shown is State.FAULT:
                self._log.error(f"{self._state()[1]}; 0 V")
            self._diagnostics.publish()

    def _totals(self) -> dict[str, int]:
        """Return how often each thing out of the ordinary has happened since the start."""
        clock = self._wheel.clock
        usual = (Verdict.FRESH, Verdict.FIRST)
        totals = {v.value: n for v, n in clock.counts.items() if v not in usual}
        return {**totals, "clock jumps": clock.jumps, **self._wheel.refused}

    def _state(self) -> tuple[bytes, str]:
        wheel = self._wheel
        fault = wheel.recovery.fault
        if fault is not None and wheel.state is not State.INACTIVE:
            ending = "; latched: call ~/reset" if wheel.recovery.latched else ""
            return runtime.ERROR, fault.value + ending
        more = f" ({wheel.owner})" if wheel.state is State.NOT_OURS else ""
        if wheel.state is State.NO_FEEDBACK and wheel.clock.gap:
            more = (
                f"; motor_state came {wheel.clock.gap:.3g} s after the one before, and "
                f"feedback_timeout is {wheel.settings.feedback_timeout:g} s: raise it for feedback "
                "that is so slow"
            )
        return _LEVELS.get(wheel.state, runtime.ERROR), wheel.state.value + more

    def _swing(self) -> str:
        """Return what is to be said of a wheel that swings around its set-point."""
        wheel, found = self._wheel, self._wheel.oscillation.found
        if found is None or wheel.state is not State.DRIVING:
            return ""
        rate = 1.0 / wheel.clock.dt if wheel.clock.dt else 0.0
        return (
            f"the speed swings by {found.amplitude:.2g} rad/s around {wheel.target:.2g} rad/s at "
            f"{found.frequency:.2g} Hz: the gains are too high for feedback at {rate:.0f} Hz; "
            f"halve p, i and d, or design them by tune --rate {rate:.0f}"
        )

    def _strain(self) -> str:
        """Return what is to be said of a wheel that turns too slowly for its voltage."""
        strain = self._wheel.strain
        if strain is None:
            return ""
        return (
            f"it gets {strain[0]:.2g} V for {abs(self._wheel.measurement):.2g} rad/s, and "
            f"{strain[1]:.2g} V would do: a heavy load, or an encoder that loses counts; look at "
            "both before it overheats"
        )

    def _assess(self) -> tuple[bytes, str, Mapping[str, object]]:
        level, message = self._state()
        totals = self._totals()
        recent = {key: n - self._reported.get(key, 0) for key, n in totals.items()}
        listed = ", ".join(f"{n} x {key}" for key, n in recent.items() if n)
        if listed:
            message = f"{message}; in the last second: {listed}"
            level = max(level, runtime.WARN)
        advice = [text for text in (self._wheel.advice, self._swing(), self._strain()) if text]
        if self._wheel.loop.wraps_at:
            advice.append(
                f"encoder_count wraps at {self._wheel.loop.wraps_at} bits, and motor_description "
                "says otherwise: set its encoder_bits to that"
            )
        advice += [two_publishers(self._node, t) for t, one in self._watches.items() if one.doubled]
        if self._wheel.clock.unstamped:
            advice.append(UNSTAMPED)
        if advice:
            level = max(level, runtime.WARN)
        if untuned(self._wheel.settings.loop.gains):
            advice.append(UNTUNED)
        if self._diagnostics.due:
            self._reported = totals
            gc.collect()
        wheel, clock = self._wheel, self._wheel.clock
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
    """Return what the controller has just computed, as a message."""
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
