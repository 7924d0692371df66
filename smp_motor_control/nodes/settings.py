# SPDX-License-Identifier: Apache-2.0
"""ROS parameters as a frozen dataclass that is replaced atomically.

A node describes its parameters by :mod:`smp_motor_control.fields`::

    parameters = Parameters(node, Settings)
    parameters.settings.timeout

All parameters of a call are validated together before they take effect; a refused call changes
nothing and returns the reason.  ``__post_init__`` of the settings checks relations between values
and raises ParameterError.
"""

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Generic, TypeVar

from rcl_interfaces import msg
from rclpy.node import Node
from rclpy.parameter import Parameter

from smp_motor_control.errors import ParameterError, check_range
from smp_motor_control.fields import Described, build_settings, parameters_in

S = TypeVar("S")

_COMMON_PARAMETERS = ("use_sim_time", "start_type_description_service")


def coerce(name: str, value: Any, default: Any) -> Any:
    """Return a parameter's value converted to the type of its default."""
    wanted = type(default)
    if wanted is float and type(value) is int:
        return float(value)
    if wanted is tuple:
        if isinstance(value, (str, bytes)) or not isinstance(value, Sequence):
            raise ParameterError(f"{name} is {value!r}; it must be a list")
        inner = default[0] if default else ""
        return tuple(coerce(f"{name}[{k}]", one, inner) for k, one in enumerate(value))
    if type(value) is not wanted:
        word = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
        raise ParameterError(f"{name} is {value!r}; it must be {word[wanted]}")
    return value


class Parameters(Generic[S]):
    """Declare a node's parameters and keep the ``settings`` built from them."""

    def __init__(
        self,
        node: Node,
        settings: type[S],
        changed: Callable[[S], None] | None = None,
        also_known: Iterable[str] = (),
        check: Callable[[S], None] = lambda settings: None,
    ) -> None:
        self._type = settings
        self._entries = parameters_in(settings)
        self._changed = changed
        self._node = node
        given = given_parameters(node)
        self._check = check
        self._warn_of_unknown(given, tuple(also_known))
        values = {
            name: coerce(name, given.get(name, entry.default), entry.default)
            for name, entry in self._entries.items()
        }
        self._values = values
        self.settings = self._build(values)
        check(self.settings)
        for name, entry in self._entries.items():
            value = list(values[name]) if isinstance(values[name], tuple) else values[name]
            # Values are already validated, with better messages than those of rclpy.
            node.declare_parameter(name, value, _descriptor(entry), ignore_override=True)
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._replace)

    def _warn_of_unknown(self, given: Iterable[str], also_known: tuple[str, ...]) -> None:
        prefixes = tuple(name for name in also_known if name.endswith("."))
        known = {*self._entries, *also_known, *_COMMON_PARAMETERS}
        for name in given:
            if name not in known and not name.startswith(("qos_overrides.", *prefixes)):
                nearest = difflib.get_close_matches(name, self._entries, 1, 0.0)
                hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
                self._node.get_logger().warning(f"unknown parameter {name!r} is ignored{hint}")

    def _build(self, values: Mapping[str, Any]) -> S:
        for name, entry in self._entries.items():
            if entry.limited:
                check_range(name, values[name], entry.minimum, entry.maximum)
        try:
            return build_settings(self._type, values)
        except ArithmeticError as error:
            raise ParameterError(f"computation fails with these values: {error}") from error

    def _merge(self, parameters: Iterable[Parameter]) -> dict[str, Any]:
        mine = (p for p in parameters if p.name in self._entries)
        new = {p.name: coerce(p.name, p.value, self._entries[p.name].default) for p in mine}
        return {**self._values, **new}

    def _validate(self, parameters: list[Parameter]) -> msg.SetParametersResult:
        try:
            self._check(self._build(self._merge(parameters)))
        except ParameterError as error:
            return msg.SetParametersResult(successful=False, reason=str(error))
        return msg.SetParametersResult(successful=True)

    def _replace(self, parameters: list[Parameter]) -> None:
        values = self._merge(parameters)
        if values == self._values:
            return
        self._values = values
        self.settings = self._build(values)
        if self._changed is not None:
            self._changed(self.settings)


def given_parameters(node: Node) -> dict[str, Any]:
    """Return the parameters that command line, launch and parameter files set for a node."""
    return {name: parameter.value for name, parameter in node._parameter_overrides.items()}


def _descriptor(entry: Described) -> msg.ParameterDescriptor:
    descriptor = msg.ParameterDescriptor(
        description=entry.text,
        read_only=entry.read_only,
        # `coerce` checks types: it accepts 1 for 1.0.
        dynamic_typing=True,
    )
    if entry.limited and isinstance(entry.default, float):
        low, high = max(float(entry.minimum), -1.7e308), min(float(entry.maximum), 1.7e308)
        descriptor.floating_point_range = [msg.FloatingPointRange(from_value=low, to_value=high)]
    elif entry.limited:
        low, high = max(entry.minimum, -(2**31)), min(entry.maximum, 2**31 - 1)
        descriptor.integer_range = [msg.IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor
