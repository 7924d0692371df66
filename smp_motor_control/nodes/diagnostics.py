"""A node's health on ``/diagnostics``."""

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from smp_motor_control.nodes.conventions import steady_timer

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Diagnostics:
    """Publishes a node's health on ``/diagnostics``, every second and at once on a change."""

    def __init__(
        self,
        node: Node,
        assess: Callable[[], tuple[bytes, str, Mapping[str, object]]],
        hardware_id: str = "",
    ) -> None:
        self._node = node
        self._assess = assess
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = steady_timer(node, 1.0, self._tick)
        self.due = False  # whether ``assess`` is asked for the report of the second

    def _tick(self) -> None:
        self.due = True
        self.publish()
        self.due = False

    def destroy(self) -> None:
        """Fall silent and give the topic back."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)

    def publish(self) -> None:
        """Publish the present health now."""
        level, message, values = self._assess()
        clock = self._node.get_clock()
        if clock.ros_time_is_active and clock.now().nanoseconds == 0:
            level = max(level, WARN)
            message = f"use_sim_time is set, but nothing is heard on /clock; {message}"
        array = DiagnosticArray()
        array.header.stamp = clock.now().to_msg()
        array.status = [
            DiagnosticStatus(
                level=level,
                name=self._name,
                message=message,
                hardware_id=self._hardware_id,
                values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
            )
        ]
        self._publisher.publish(array)


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
