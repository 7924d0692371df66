# SPDX-License-Identifier: Apache-2.0
"""Sends a bounded test voltage to one or all wheels for a limited time, then zero.

Exits with code 0 at the end and always sends a final zero.  A wheel that another node drives is
refused: deactivate its controller first.  A wheel that exceeds its speed or current limit, or
stops reporting, ends the test of all wheels with exit code 1.
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
from smp_motor_control.excitation import SIGNALS, Excitation
from smp_motor_control.fields import fixed
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.motor_writer import MotorWriter
from smp_motor_control.nodes.publishers import PublisherWatch, describe_two_publishers
from smp_motor_control.nodes.settings import Parameters
from smp_motor_control.wheel.protection import Bounds, Protection

_CONNECTION_WAIT_S = 0.5  # for other subscribers than the driver
_SILENCE_S = 1.0
"""Silence of a wheel that ends the test, counted in commands: a paused process does not count."""


class LimitError(SmpError):
    """A wheel exceeded a limit."""

    exit_code = 1


@dataclass(frozen=True, kw_only=True)
class Settings:
    signal: str = fixed("fourier", f"One of {', '.join(SIGNALS)}.")
    wheel_names: tuple[str, ...] = fixed(WHEELS, "Wheels of the robot.")
    wheels: tuple[str, ...] = fixed(("all",), "Wheels to excite, or all.")
    amplitude: float = fixed(6.0, "Amplitude of the voltage [V].", minimum=0.0)
    max_voltage: float = fixed(12.0, "Maximum amplitude [V].", minimum=0.0)
    max_speed: float = fixed(0.0, "Speed limit of a wheel [rad/s]; 0: none.", minimum=0.0)
    max_current: float = fixed(0.0, "Current limit of a motor [A]; 0: none.", minimum=0.0)
    duration: float = fixed(20.0, "Duration of the signal [s].", minimum=0.1, maximum=3600.0)
    fade: float = fixed(0.0, "Time of fading in, and of fading out [s].", minimum=0.0)
    rate: float = fixed(200.0, "Commands per second [Hz].", minimum=10.0, maximum=1000.0)
    wait: float = fixed(10.0, "Maximum wait for the motors' driver [s].", minimum=0.0)
    seed: int = fixed(0, "Seed of fourier, prbs and steps.", minimum=0)
    independent: bool = fixed(True, "Whether the wheels' random signals differ.")
    frequency: float = fixed(1.0, "Frequency of sine and square [Hz].", minimum=0.0)
    lowest: float = fixed(0.1, "Lowest frequency of fourier [Hz].", minimum=0.0)
    highest: float = fixed(20.0, "Highest frequency of fourier [Hz].", minimum=0.0)
    tones: int = fixed(24, "Number of tones of fourier.", minimum=2, maximum=1000)
    hold: float = fixed(0.0, "Step length of prbs and steps [s]; 0: default.", minimum=0.0)
    period: float = fixed(20.0, "Period of ramp [s].", minimum=0.0)

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
        self.make_signal(0)

    def chosen(self) -> tuple[str, ...]:
        return self.wheel_names if "all" in self.wheels else self.wheels

    def make_signal(self, wheel: int) -> Excitation:
        """Return the signal of the n-th wheel."""
        kind = SIGNALS[self.signal]
        given = {f.name: getattr(self, f.name) for f in fields(kind) if hasattr(self, f.name)}
        if not given.get("hold", 1.0):
            del given["hold"]
        if "seed" in given and self.independent:
            given["seed"] += wheel
        return kind(**given)


class Excite(Node):
    def __init__(self) -> None:
        super().__init__("excite")
        settings = Parameters(self, Settings).settings
        self._settings = settings
        self._outputs: list[tuple[MotorWriter, Excitation]] = []
        self._protections: dict[str, Protection] = {}
        self._silence: dict[str, float] = {}
        self._publisher_watches: dict[str, PublisherWatch] = {}
        bounds = Bounds(speed=settings.max_speed, current=settings.max_current)
        for k, wheel in enumerate(settings.chosen()):
            signal = settings.make_signal(k)
            signal(0.0)  # initialise before the first period
            self._outputs.append((MotorWriter(self, f"{wheel}/"), signal))
            self._protections[wheel] = Protection(bounds)
            self._publisher_watches[wheel] = PublisherWatch()
            topic, take = f"{wheel}/motor_state", partial(self._on_motor_state, wheel)
            self.create_subscription(MotorState, topic, take, runtime.STREAM_SUBSCRIBER)
        self._begin: float | None = None
        self._connected_since = math.inf
        self._created = time.monotonic()
        self._diagnostics = runtime.Diagnostics(self, self._assess)
        self._timer = runtime.steady_timer(self, 1.0 / settings.rate, self._on_timer)

    def _on_timer(self) -> None:
        now, settings = time.monotonic(), self._settings
        if self._begin is None:
            if not self._is_connected(now):
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
                    f"{writer.publisher.topic_name}: rejected, {writer.owner} owns this wheel; "
                    "deactivate it first"
                )
            writer.send(signal(elapsed), stamp)
        for wheel in self._silence:
            self._silence[wheel] += 1.0 / settings.rate
            if self._silence[wheel] > _SILENCE_S:
                raise LimitError(
                    f"{wheel}: no motor_state for {_SILENCE_S:g} s; is its driver running?"
                )

    def _on_motor_state(self, wheel: str, message: MotorState, info: Mapping[str, Any]) -> None:
        self._silence[wheel] = 0.0
        self._publisher_watches[wheel].hear(info)
        if self._publisher_watches[wheel].has_two_publishers:
            raise LimitError(describe_two_publishers(self, f"{wheel}/motor_state"))
        stamp = runtime.seconds(message.header.stamp)
        why = self._protections[wheel].add(stamp, message.current, message.velocity)
        if why and self._begin is not None:
            raise LimitError(f"{wheel}: {why}")

    def _is_connected(self, now: float) -> bool:
        publishers = [writer.publisher for writer, _ in self._outputs]
        silent = [p.topic_name for p in publishers if not p.get_subscription_count()]
        if silent and now - self._created > self._settings.wait:
            raise ParameterError(
                f"no subscriber on {', '.join(silent)}; is the driver or motor_plant running?"
            )
        if silent:
            self._connected_since = math.inf
            return False
        # Wait briefly for subscribers and wheels that are discovered but not yet connected.
        self._connected_since = min(self._connected_since, now)
        waited = now - self._connected_since
        unheard = (wheel for wheel in self._protections if wheel not in self._silence)
        known = all(
            p.get_subscription_count() >= self.count_subscribers(p.topic_name) for p in publishers
        ) and not any(self.count_publishers(f"{wheel}/motor_state") for wheel in unheard)
        return waited > _CONNECTION_WAIT_S and (known or waited > 4 * _CONNECTION_WAIT_S)

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
