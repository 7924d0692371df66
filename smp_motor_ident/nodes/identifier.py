"""``identifier``: what the running motors show of themselves, while they run.

Keeps a window of every wheel's ``motor_state``, estimates from it in a thread beside the
callbacks, and publishes ``MotorParameters``.  Before a window has seen enough (time, motion,
levels and changes of voltage, both directions) the message has no numbers and its ``status``
begins with ``collecting`` and says what is missing; else it begins with ``valid`` or, with the
reason, ``unreliable``, or ``refused`` with the reason.
"""

from __future__ import annotations

import sys
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

from builtin_interfaces.msg import Time
from rclpy.node import Node

from smp_interfaces.msg import MotorDescription, MotorParameters, MotorState
from smp_motor_control import WHEELS, joint_of
from smp_motor_control.errors import ParameterError, SmpError
from smp_motor_control.nodes import runtime
from smp_motor_control.nodes.settings import Parameters, described, nested
from smp_motor_ident.estimate import estimate
from smp_motor_ident.estimation.live import Demands, Window, missing
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.result import Estimate


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Parameters of the node."""

    wheels: tuple[str, ...] = described(WHEELS, "Wheels to identify.", read_only=True)
    window: float = described(
        30.0, "How much of the past is used [s].", minimum=2.0, maximum=600.0, read_only=True
    )
    period: float = described(
        5.0, "Interval between two estimates of a wheel [s].", minimum=0.5, read_only=True
    )
    model: str = described("auto", "Model to fit; auto chooses the simplest that holds.")
    demands: Demands = nested(  # noqa: RUF009 (returns a field)
        Demands(),
        {
            "duration": "Least time in the window [s].",
            "moving": "Least time of motion in it [s].",
            "bins": "Levels that the range of voltages is cut into [1].",
            "filled": "Least number of levels that occurred [1].",
            "changes": "Least number of times that the voltage crossed its mean [1].",
            "both_directions": "Whether the motor must have turned both ways.",
        },
        prefix="demands.",
    )

    def __post_init__(self) -> None:
        """Refuse a window that can never meet its demands."""
        if self.demands.duration > self.window:
            raise ParameterError(
                f"demands.duration is {self.demands.duration:g} s; it must not exceed the "
                f"window of {self.window:g} s"
            )


class Wheel:
    """One wheel's window, topics and last answer."""

    def __init__(self, node: Node, name: str, length: float) -> None:
        self.window = Window(name, length)
        self.joint_name = joint_of(name)
        self.stamp = Time()
        self.status = "collecting: no motor_state yet"
        self.running: Future[Estimate] | None = None
        self.publisher = node.create_publisher(
            MotorParameters, f"{name}/motor_parameters", runtime.LATCHED
        )
        topic = f"{name}/motor_state"
        node.create_subscription(MotorState, topic, self._on_state, runtime.STREAM_SUBSCRIBER)
        topic = f"{name}/motor_description"
        node.create_subscription(MotorDescription, topic, self._on_description, runtime.LATCHED)

    def _on_state(self, message: MotorState) -> None:
        self.stamp = message.header.stamp
        self.window.add(
            runtime.seconds(message.header.stamp),
            message.voltage,
            message.current,
            message.velocity,
            message.position,
            message.encoder_count,
        )

    def _on_description(self, message: MotorDescription) -> None:
        self.joint_name = message.joint_name or self.joint_name
        self.window.hardware = Hardware(
            gear_ratio=message.gear_ratio if message.gear_ratio > 0 else 1.0,
            counts_per_revolution=_positive(message.counts_per_revolution),
            encoder_bits=message.encoder_bits,
            supply_voltage=_positive(message.supply_voltage),
            resistance=_positive(message.resistance),
        )

    def tell(self, status: str, found: Estimate | None = None) -> None:
        """Publish an answer."""
        self.status = status
        message = MotorParameters(joint_name=self.joint_name, status=status)
        message.header.stamp = self.stamp
        message.header.frame_id = self.joint_name
        message.fit_percent = float("nan")
        if found is not None:
            held = {**found.combinations, **found.parameters}
            known = {name: q for name, q in held.items() if q.value is not None}
            message.model = found.model
            message.names = list(known)
            message.values = [float(q.value) for q in known.values() if q.value is not None]
            message.std_devs = [float(q.std or 0.0) for q in known.values()]
            fit = found.fit_percent
            best = fit.validation if fit.validation is not None else fit.estimation
            message.fit_percent = float("nan") if best is None else float(best)
        self.publisher.publish(message)


class Identifier(Node):
    """The node: windows fill in callbacks, one thread estimates wheel after wheel."""

    def __init__(self) -> None:
        super().__init__("identifier")
        self._given = Parameters(self, Settings)
        settings = self._given.settings
        self._wheels = {name: Wheel(self, name, settings.window) for name in settings.wheels}
        self._worker = ThreadPoolExecutor(max_workers=1)
        self._diagnostics = runtime.Diagnostics(self, self._assess)
        runtime.steady_timer(self, settings.period, self._begin_all)
        runtime.steady_timer(self, 0.1, self._publish_finished)

    def _begin_all(self) -> None:
        """Hand every window that shows enough to the worker."""
        settings = self._given.settings
        for wheel in self._wheels.values():
            if wheel.running is not None:
                continue
            record = wheel.window.record()
            lacks = missing(record, settings.demands)
            if lacks or record is None:
                wheel.tell("collecting: " + "; ".join(lacks))
            else:
                wheel.running = self._worker.submit(partial(_identify, record, settings.model))

    def _publish_finished(self) -> None:
        for wheel in self._wheels.values():
            if wheel.running is None or not wheel.running.done():
                continue
            future, wheel.running = wheel.running, None
            error = future.exception()
            if error is None:
                found = future.result()
                why = "; ".join(f.message for f in found.findings if f.severity == "unreliable")
                wheel.tell(f"unreliable: {why}" if why else "valid", found)
            elif isinstance(error, SmpError):
                wheel.tell(f"refused: {error}")
            else:
                self.get_logger().error(f"{wheel.window.wheel}: {error!r}")
                wheel.tell(f"refused: the estimator failed with {error!r}")

    def _assess(self) -> tuple[bytes, str, dict[str, object]]:
        states = {name: wheel.status for name, wheel in self._wheels.items()}
        valid = sum(text.startswith("valid") for text in states.values())
        level = runtime.OK if valid == len(states) else runtime.WARN
        return level, f"{valid} of {len(states)} wheels identified", dict(states)

    def on_stop(self) -> None:
        """Do not wait for an estimate that nobody will hear of."""
        self._worker.shutdown(wait=False, cancel_futures=True)


def _positive(value: float) -> float | None:
    return value if value > 0 else None


def _identify(record: Record, model: str) -> Estimate:
    return estimate([record], model=model)


def main(argv: list[str] | None = None) -> int:
    """Run the node."""
    return runtime.run("identifier", Identifier, argv)


if __name__ == "__main__":
    sys.exit(main())
