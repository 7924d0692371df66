# SPDX-License-Identifier: Apache-2.0
"""Estimates the motors while they run.

Keeps a window of every wheel's ``motor_state``, estimates from it in a separate thread, and
publishes ``MotorParameters``.  While a window lacks excitation (time, motion, levels and
changes of voltage, both directions), the message has no numbers, and its ``status`` begins with
``collecting`` and lists the missing excitation. Otherwise it begins with ``valid``, or with
``unreliable`` or ``refused`` and the reason.

With ``commissioned`` it also tracks resistance, motor constant and friction of these motors, warns
on ``/diagnostics`` when one has left its band, and appends a line per wheel and minute to
``history``, which ``identify --history`` draws.  It changes no gains.
"""

import math
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from smp_interfaces.msg import MotorDescription, MotorParameters, MotorState
from smp_motor_control import WHEELS, check_wheel_names, get_joint_name
from smp_motor_control.encoder import wrap
from smp_motor_control.errors import ParameterError, SmpError
from smp_motor_control.fields import described, fixed
from smp_motor_control.nodes import executor, runtime
from smp_motor_control.nodes.publishers import PublisherWatch, describe_two_publishers
from smp_motor_control.nodes.settings import Parameters
from smp_motor_ident.bag import read
from smp_motor_ident.bag.window import Window
from smp_motor_ident.estimate import estimate
from smp_motor_ident.live.demands import MIN_DURATION_S, find_missing_excitation
from smp_motor_ident.live.monitor import Monitor, read_commissioned_values
from smp_motor_ident.record import Record
from smp_motor_ident.report import document, history
from smp_motor_ident.result import Estimate

STATE_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Depth of the queue, since samples wait on a busy machine and a lost one harms the fit."""

TAKE_PERIOD_S = 0.05
"""Between two batches of samples [s]: waking up for each would cost half as much again."""

HISTORY_PERIOD_S = 60.0  # between two lines of a history [s]


@dataclass(frozen=True, kw_only=True)
class Settings:
    wheels: tuple[str, ...] = fixed(WHEELS, "Wheels to identify.")
    window: float = fixed(
        60.0, "Length of the window of samples [s].", minimum=MIN_DURATION_S, maximum=600.0
    )
    period: float = fixed(
        5.0, "Minimum interval between two estimates of a wheel [s].", minimum=0.5
    )
    share: float = described(
        0.03, "Largest share of a processor for estimates in the long run.",
        minimum=1e-3, maximum=1.0,
    )  # fmt: skip
    model: str = described(
        "auto",
        "Model: first_order, second_order, electromechanical, or auto (the simplest adequate one).",
    )
    commissioned: str = fixed(
        "", "identification.json, or its folder, of the motors to watch; empty: none."
    )
    history: str = fixed(
        "", "File to which the history of watched motors is appended; empty: none."
    )

    def __post_init__(self) -> None:
        check_wheel_names(self.wheels)


class Wheel:
    """One wheel's window, topics and last estimate."""

    def __init__(self, node: Node, name: str, length: float, monitor: Monitor | None) -> None:
        self.window = Window(name, length)
        self.watch = PublisherWatch()
        self.monitor = monitor
        self._count: int | None = None
        self._position = math.nan
        self.joint_name = get_joint_name(name)
        self.stamp = Time()
        self.status = "collecting: no motor_state yet"
        self.unstamped = False
        self.running: Future[tuple[Estimate | Exception, float]] | None = None
        # Stamp of the last sample when last looked at, and of the last estimate's [ns]
        self.seen = self.estimated = 0
        self.publisher = node.create_publisher(
            MotorParameters, f"{name}/motor_parameters", runtime.LATCHED
        )
        topic, group = f"{name}/motor_state", executor.PolledSubscriptions()
        self._states = node.create_subscription(
            MotorState, topic, self._on_state, STATE_QOS, callback_group=group
        )
        topic = f"{name}/motor_description"
        node.create_subscription(MotorDescription, topic, self._on_description, runtime.LATCHED)

    def take(self) -> None:
        """Take all pending samples."""
        handle = self._states.handle
        with handle:
            while (taken := handle.take_message(MotorState, False)) is not None:
                self._on_state(*taken)

    def _on_state(self, message: MotorState, info: Mapping[str, Any]) -> None:
        self.stamp = stamp = message.header.stamp
        nanoseconds = runtime.nanoseconds(stamp)
        self.unstamped = not nanoseconds
        self.watch.hear(info)
        if self.watch.has_two_publishers or self.unstamped:
            return  # the samples mix two wheels, or have no time
        if self.monitor is not None:
            turned = self._turned(message.encoder_count, message.position)
            self.monitor.add(1e-9 * nanoseconds, message.voltage, message.current, turned)
        self.window.add(nanoseconds, message, info["publication_sequence_number"] or 0)

    def _turned(self, count: int, position: float) -> float:
        """Return the motor's angle since the previous sample [rad]; NaN if unknown."""
        hardware = self.window.hardware
        before, self._count = self._count, count
        angle, self._position = self._position, position
        if hardware.counts_per_revolution is None:
            return (position - angle) * hardware.gear_ratio
        if before is None:
            return math.nan
        counts = wrap(count - before, hardware.encoder_bits)
        return counts * 2 * math.pi / hardware.counts_per_revolution

    def _on_description(self, message: MotorDescription) -> None:
        self.joint_name = message.joint_name or self.joint_name
        self.window.hardware = read.convert_description(message)

    def publish(self, status: str, found: Estimate | None = None) -> None:
        self.status = status
        message = MotorParameters(joint_name=self.joint_name, status=status)
        message.header.stamp = self.stamp
        message.header.frame_id = self.joint_name
        message.fit_percent = math.nan
        if found is not None:
            held = {**found.combinations, **found.parameters}
            known = {name: q for name, q in held.items() if q.value is not None}
            message.model = found.model
            message.names = list(known)
            message.values = [float(q.value) for q in known.values() if q.value is not None]
            message.std_devs = [float(q.std or 0.0) for q in known.values()]
            fits = (found.fit_percent.validation, found.fit_percent.estimation)
            message.fit_percent = next((float(f) for f in fits if f is not None), math.nan)
        self.publisher.publish(message)


class Identifier(Node):
    """The node: windows fill in callbacks, one thread estimates wheel after wheel."""

    def __init__(self) -> None:
        super().__init__("identifier")
        self._ros_parameters = Parameters(self, Settings)
        settings = self._ros_parameters.settings
        monitors = _make_monitors(settings)
        self._wheels = {
            name: Wheel(self, name, settings.window, monitors.get(name)) for name in settings.wheels
        }
        self._worker = ThreadPoolExecutor(max_workers=1)
        self._not_before = 0.0
        self._compiled = False  # the first estimate includes loading and compiling
        self._diagnostics = runtime.Diagnostics(self, self._assess)
        runtime.steady_timer(self, TAKE_PERIOD_S, self._take_all)
        runtime.steady_timer(self, settings.period, self._start_estimates)
        runtime.steady_timer(self, 0.1, self._publish_finished)
        if settings.history:
            runtime.steady_timer(self, HISTORY_PERIOD_S, self._add_history)

    def _take_all(self) -> None:
        for wheel in self._wheels.values():
            wheel.take()

    def _start_estimates(self) -> None:
        """Submit every window with enough excitation; report what the others lack.

        A pause in proportion to its cost follows every estimate; the last window before samples
        stop arriving skips the pause.
        """
        settings, now = self._ros_parameters.settings, time.monotonic()
        for wheel in self._wheels.values():
            ceased, wheel.seen = wheel.window.last == wheel.seen, wheel.window.last
            if wheel.running or (wheel.seen and wheel.seen == wheel.estimated):
                continue
            try:
                self._check_source(wheel)
                record = wheel.window.record()
                missing = find_missing_excitation(record)
            except (SmpError, ArithmeticError, ValueError) as error:
                record, missing = None, [str(error)]
            if missing or record is None:
                wheel.publish("collecting: " + "; ".join(missing))
            elif ceased or now >= self._not_before:
                wheel.estimated = wheel.seen
                wheel.running = self._worker.submit(partial(_identify, record, settings.model))

    def _check_source(self, wheel: Wheel) -> None:
        """Refuse samples of two publishers, and samples without a stamp."""
        topic = f"{wheel.window.wheel}/motor_state"
        if wheel.watch.has_two_publishers:
            raise SmpError(describe_two_publishers(self, topic))
        if wheel.unstamped:
            raise SmpError(f"{topic} has no stamp; its driver must set the time of sampling")

    def _publish_finished(self) -> None:
        for wheel in self._wheels.values():
            if wheel.running is None or not wheel.running.done():
                continue
            (found, cost), wheel.running = wheel.running.result(), None
            if self._compiled:
                since = max(self._not_before, time.monotonic())
                self._not_before = since + cost / self._ros_parameters.settings.share
            self._compiled = True
            if isinstance(found, Estimate):
                why = "; ".join(f.message for f in found.findings if f.severity == "unreliable")
                wheel.publish(f"unreliable: {why}" if why else "valid", found)
            elif isinstance(found, SmpError):
                wheel.publish(f"refused: {found}")
            else:
                self.get_logger().error(f"{wheel.window.wheel}: {found!r}")
                wheel.publish(f"refused: the estimator failed with {found!r}")

    def _assess(self) -> tuple[bytes, str, dict[str, object]]:
        states: dict[str, object] = {name: wheel.status for name, wheel in self._wheels.items()}
        valid = sum(wheel.status.startswith("valid") for wheel in self._wheels.values())
        level = runtime.OK if valid == len(states) else runtime.WARN
        message = f"{valid} of {len(states)} wheels identified"
        doubled = [n for n, w in self._wheels.items() if w.watch.has_two_publishers]
        if doubled:
            told = (describe_two_publishers(self, f"{name}/motor_state") for name in doubled)
            return runtime.ERROR, "; ".join(told), states
        watched = {n: w.monitor for n, w in self._wheels.items() if w.monitor is not None}
        if watched:  # then a wheel without an estimate is no warning
            level, message = runtime.OK, f"{len(watched)} wheels watched; {message}"
        for name, monitor in watched.items():
            now = monitor.values()
            for key, (state, why) in monitor.validity().items():
                value, std = now[key]
                text = f"{value:.4g} ± {1.96 * std:.2g}" if state == "estimated" else why
                states[f"{name} {key}"] = f"{state}: {text}"
            for finding in monitor.findings():
                level = runtime.WARN
                message = f"{name}: {finding.message}"
                states[f"{name} {finding.code}"] = f"{finding.message}; {finding.advice}"
        return level, message, states

    def _add_history(self) -> None:
        """Append a line for every watched wheel with estimates."""
        entries = [
            history.entry_of(runtime.seconds(wheel.stamp), name, wheel.monitor)
            for name, wheel in self._wheels.items()
            if wheel.monitor is not None
        ]
        try:
            history.append(
                Path(self._ros_parameters.settings.history), [e for e in entries if e.values]
            )
        except OSError as error:
            self.get_logger().error(f"{self._ros_parameters.settings.history}: {error.strerror}")

    def on_stop(self) -> None:
        """Stop without waiting for a running estimate."""
        self._worker.shutdown(wait=False, cancel_futures=True)


def _make_monitors(settings: Settings) -> dict[str, Monitor]:
    """Return a monitor of every wheel that was commissioned; refuse one that cannot be watched."""
    if not settings.commissioned:
        if settings.history:
            raise ParameterError(
                "history needs commissioned; give the identification of the motors"
            )
        return {}
    found = document.read_identification(Path(settings.commissioned))
    return {n: Monitor(read_commissioned_values(found[n])) for n in settings.wheels if n in found}


def _identify(record: Record, model: str) -> tuple[Estimate | Exception, float]:
    """Return the estimate of a window, or its error, and the processor time it took [s]."""
    begun = time.thread_time()
    found: Estimate | Exception
    try:
        found = estimate([record], model=model)
    except Exception as error:
        found = error
    return found, time.thread_time() - begun


main = partial(runtime.run, "identifier", Identifier)
