"""Sends a bounded test voltage to one wheel or to all, for a bounded time, and then zero.

Ends by itself with exit code 0; sends zero to every wheel whatever the reason of leaving.
A wheel that another node drives is refused: deactivate its controller, or let it rest.
A wheel that turns too fast, draws too much or is not heard any more ends the signal for
all, with exit code 1.
"""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

from rclpy.node import Node

from smp_interfaces.msg import MotorState
from smp_motor_control import WHEELS, check_wheel_names
from smp_motor_control.errors import ParameterError, SmpError
from smp_motor_control.excitation import SIGNALS, Bounded, Excitation
from smp_motor_control.fields import fixed
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.motor_writer import MotorWriter
from smp_motor_control.nodes.publishers import PublisherWatch, two_publishers
from smp_motor_control.nodes.settings import Parameters
from smp_motor_control.wheel.protection import Bounds, Protection

_OTHERS = 0.5  # time [s] that other listeners than the driver are given to connect
_SILENCE = 1.0
"""A wheel that was heard is missed after commands of so long [s]; time in which this process did
not run does not count."""


class LimitError(SmpError):
    """A wheel left what it may reach."""

    exit_code = 1


@dataclass(frozen=True, kw_only=True)
class Settings:
    signal: str = fixed("fourier", f"One of {', '.join(SIGNALS)}.")
    wheel_names: tuple[str, ...] = fixed(WHEELS, "Wheels of the robot.")
    wheels: tuple[str, ...] = fixed(("all",), "Wheels to excite, or all of wheel_names.")
    amplitude: float = fixed(6.0, "Largest voltage of either sign [V].", minimum=0.0)
    max_voltage: float = fixed(12.0, "Amplitudes beyond this are refused [V].", minimum=0.0)
    max_speed: float = fixed(0.0, "Largest speed of a wheel [rad/s]; 0 for any.", minimum=0.0)
    max_current: float = fixed(0.0, "Largest current of a motor [A]; 0 for any.", minimum=0.0)
    duration: float = fixed(20.0, "Length of the signal [s].", minimum=0.1, maximum=3600.0)
    fade: float = fixed(0.0, "Time over which it grows and shrinks [s].", minimum=0.0)
    rate: float = fixed(200.0, "Commands per second [Hz].", minimum=10.0, maximum=1000.0)
    wait: float = fixed(10.0, "Longest wait for the motors' driver [s].", minimum=0.0)
    seed: int = fixed(0, "Of fourier, prbs and steps.", minimum=0)
    independent: bool = fixed(True, "Whether wheels get different fourier, prbs and steps signals.")
    frequency: float = fixed(1.0, "Of sine and square [Hz].", minimum=0.0)
    lowest: float = fixed(0.1, "Lowest frequency of fourier and chirp [Hz].", minimum=0.0)
    highest: float = fixed(20.0, "Highest frequency of fourier and chirp [Hz].", minimum=0.0)
    tones: int = fixed(24, "Tones of fourier.", minimum=2, maximum=1000)
    sweep: float = fixed(20.0, "One sweep of chirp [s].", minimum=0.0)
    hold: float = fixed(0.0, "Of prbs and steps [s]; 0 for their defaults.", minimum=0.0)
    period: float = fixed(20.0, "Of ramp [s].", minimum=0.0)

    def __post_init__(self) -> None:
        if self.signal not in SIGNALS:
            raise ParameterError(f"signal is {self.signal!r}; known are {', '.join(SIGNALS)}")
        check_wheel_names(self.wheel_names)
        check_wheel_names(self.chosen())
        if self.amplitude > self.max_voltage:
            raise ParameterError(
                f"amplitude is {self.amplitude:g} V; it must not exceed max_voltage, "
                f"{self.max_voltage:g} V"
            )
        self.signal_of(0)

    def chosen(self) -> tuple[str, ...]:
        return self.wheel_names if "all" in self.wheels else self.wheels

    def signal_of(self, wheel: int) -> Excitation:
        """Return the bounded signal of the n-th wheel."""
        kind = SIGNALS[self.signal]
        given = {f.name: getattr(self, f.name) for f in fields(kind) if hasattr(self, f.name)}
        if not given.get("hold", 1.0):
            del given["hold"]
        if "seed" in given and self.independent:
            given["seed"] += wheel
        return Bounded(signal=kind(**given), duration=self.duration, fade=self.fade)


class Excite(Node):
    def __init__(self) -> None:
        super().__init__("excite")
        settings = Parameters(self, Settings).settings
        self._settings = settings
        self._outputs: list[tuple[MotorWriter, Excitation]] = []
        self._watched: dict[str, Protection] = {}
        self._unheard: dict[str, float] = {}
        self._states: dict[str, PublisherWatch] = {}
        bounds = Bounds(speed=settings.max_speed, current=settings.max_current)
        for k, wheel in enumerate(settings.chosen()):
            signal = settings.signal_of(k)
            signal(0.0)  # Prepared now, not in the first period.
            self._outputs.append((MotorWriter(self, f"{wheel}/"), signal))
            self._watched[wheel] = Protection(bounds)
            self._states[wheel] = PublisherWatch()
            topic, take = f"{wheel}/motor_state", partial(self._watch, wheel)
            self.create_subscription(MotorState, topic, take, runtime.STREAM_SUBSCRIBER)
        self._begin: float | None = None
        self._all_heard = math.inf
        self._created = time.monotonic()
        self._diagnostics = runtime.Diagnostics(self, self._assess)
        self._timer = runtime.steady_timer(self, 1.0 / settings.rate, self._tick)

    def _tick(self) -> None:
        now, settings = time.monotonic(), self._settings
        if self._begin is None:
            if not self._heard(now):
                return
            self._begin = now
            self.get_logger().info(
                f"{settings.signal} of {settings.amplitude:g} V for {settings.duration:g} s "
                f"on {', '.join(settings.chosen())}"
            )
        elapsed = now - self._begin
        if elapsed >= settings.duration:
            self._timer.cancel()
            runtime.finish()
            return
        stamp = self.get_clock().now().to_msg()
        for writer, signal in self._outputs:
            if writer.owner:
                raise ParameterError(
                    f"{writer.publisher.topic_name}: not yours, {writer.owner} drives this wheel; "
                    "deactivate it first"
                )
            writer.send(signal(elapsed), stamp)
        for wheel in self._unheard:
            self._unheard[wheel] += 1.0 / settings.rate
            if self._unheard[wheel] > _SILENCE:
                raise LimitError(
                    f"{wheel}: no motor_state for {_SILENCE:g} s; does its driver run?"
                )

    def _watch(self, wheel: str, message: MotorState, info: Mapping[str, Any]) -> None:
        self._unheard[wheel] = 0.0
        self._states[wheel].hear(info)
        if self._states[wheel].doubled:
            raise LimitError(two_publishers(self, f"{wheel}/motor_state"))
        stamp = runtime.seconds(message.header.stamp)
        why = self._watched[wheel].add(stamp, message.current, message.velocity)
        if why and self._begin is not None:
            raise LimitError(f"{wheel}: {why}")

    def _heard(self, now: float) -> bool:
        publishers = [writer.publisher for writer, _ in self._outputs]
        silent = [p.topic_name for p in publishers if not p.get_subscription_count()]
        if silent and now - self._created > self._settings.wait:
            raise ParameterError(
                f"nobody listens on {', '.join(silent)}; is the driver or motor_plant running?"
            )
        if silent:
            self._all_heard = math.inf
            return False
        # Recorders and wheels that are known but not connected yet are waited for, a little.
        self._all_heard = min(self._all_heard, now)
        waited = now - self._all_heard
        unheard = (wheel for wheel in self._watched if wheel not in self._unheard)
        known = all(
            p.get_subscription_count() >= self.count_subscribers(p.topic_name) for p in publishers
        ) and not any(self.count_publishers(f"{wheel}/motor_state") for wheel in unheard)
        return waited > _OTHERS and (known or waited > 4 * _OTHERS)

    def _assess(self) -> tuple[bytes, str, Mapping[str, object]]:
        if self._begin is None:
            return runtime.WARN, "waiting for the driver", {}
        elapsed = time.monotonic() - self._begin
        return runtime.OK, "exciting", {"elapsed [s]": elapsed, "of [s]": self._settings.duration}

    def on_stop(self) -> None:
        """Send zero to every wheel before the process ends."""
        for writer, _ in self._outputs:
            writer.stop()


main = partial(runtime.run, "excite", Excite)
