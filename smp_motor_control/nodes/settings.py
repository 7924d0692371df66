"""ROS parameters as a frozen dataclass that is replaced as a whole, or not at all.

A node describes its parameters once::

    @dataclass(frozen=True, kw_only=True)
    class Settings:
        timeout: float = described(0.5, "Silence after which the wheel stops [s].", minimum=0.0)

        def __post_init__(self) -> None:  # relations between values; raises ParameterError
            ...

    parameters = Parameters(node, Settings)
    parameters.settings.timeout

A change is validated, as one with all that is set in the same call, before it takes effect;
a refused one leaves the node as it was and the service call says why.
"""

import dataclasses
import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from smp_motor_control import fields
from smp_motor_control.errors import ParameterError

S = TypeVar("S")

_OF_EVERY_NODE = ("use_sim_time", "start_type_description_service")


def described(
    default: Any,
    description: str,
    *,
    minimum: float = -math.inf,
    maximum: float = math.inf,
    read_only: bool = False,
    name: str = "",
) -> Any:
    """Return a dataclass field that becomes a ROS parameter."""
    limits = {"minimum": minimum, "maximum": maximum}
    return fields.described(default, description, read_only=read_only, name=name, **limits)


def fixed(default: Any, description: str, **limits: float) -> Any:
    """Return a field as :func:`described` does, of a parameter that only the start can set."""
    return described(default, description, read_only=True, **limits)


def nested(default: Any, descriptions: Mapping[str, str] | None = None, *, prefix: str = "") -> Any:
    """Return a dataclass field whose own fields become ROS parameters; they may be described."""
    if descriptions is None:
        inner = dataclasses.fields(default)
        descriptions = {field.name: field.metadata["description"] for field in inner}
    metadata = {"descriptions": descriptions, "prefix": prefix}
    return dataclasses.field(default=default, metadata=metadata)


def fields_for(kind: type, settings: Any, prefix: str = "") -> dict[str, Any]:
    """Return the settings that are named, behind a prefix, as the fields of another dataclass."""
    names = [field.name for field in dataclasses.fields(kind)]
    return {n: getattr(settings, prefix + n) for n in names if hasattr(settings, prefix + n)}


@dataclasses.dataclass(frozen=True)
class _Entry:
    """One ROS parameter and the place in the settings it belongs to."""

    path: tuple[str, ...]
    default: Any
    description: str
    minimum: float = -math.inf
    maximum: float = math.inf
    read_only: bool = False

    @property
    def limited(self) -> bool:
        """Whether it is a number with a limit."""
        return math.isfinite(self.minimum) or math.isfinite(self.maximum)


def _entries(settings: type) -> dict[str, _Entry]:
    found = {}
    for field in dataclasses.fields(settings):
        data = field.metadata
        if "descriptions" in data:
            for name, description in data["descriptions"].items():
                default = getattr(field.default, name)
                found[data["prefix"] + name] = _Entry((field.name, name), default, description)
        elif "description" in data:
            limits = {key: data[key] for key in ("minimum", "maximum", "read_only")}
            name = data["name"] or field.name
            found[name] = _Entry((field.name,), field.default, data["description"], **limits)
    return found


def coerce(name: str, value: Any, default: Any) -> Any:
    """Return a parameter's value in the type of its default."""
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


def _check_range(name: str, value: Any, entry: _Entry) -> None:
    low, high = entry.minimum, entry.maximum
    if entry.limited and not low <= value <= high:
        raise ParameterError(f"{name} is {value!r}; it must be in [{low:g}, {high:g}]")


class Parameters(Generic[S]):
    """Declares a node's parameters and keeps the ``settings`` made of them."""

    def __init__(
        self,
        node: Node,
        settings: type[S],
        changed: Callable[[S], None] | None = None,
        also_known: Iterable[str] = (),
        check: Callable[[S], None] = lambda settings: None,
    ) -> None:
        self._type = settings
        self._entries = _entries(settings)
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
            value = values[name]
            # Given values were validated above; the override would be checked again, worse.
            node.declare_parameter(
                name,
                list(value) if isinstance(value, tuple) else value,
                _descriptor(entry),
                ignore_override=True,
            )
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._replace)

    def _warn_of_unknown(self, given: Iterable[str], also_known: tuple[str, ...]) -> None:
        prefixes = tuple(name for name in also_known if name.endswith("."))
        known = {*self._entries, *also_known, *_OF_EVERY_NODE}
        for name in given:
            if name not in known and not name.startswith(("qos_overrides.", *prefixes)):
                nearest = difflib.get_close_matches(name, self._entries, 1, 0.0)
                hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
                self._node.get_logger().warning(f"unknown parameter {name!r} is ignored{hint}")

    def _build(self, values: Mapping[str, Any]) -> S:
        top: dict[str, Any] = {}
        inner: dict[str, dict[str, Any]] = {}
        for name, entry in self._entries.items():
            _check_range(name, values[name], entry)
            if len(entry.path) == 1:
                top[entry.path[0]] = values[name]
            else:
                inner.setdefault(entry.path[0], {})[entry.path[1]] = values[name]
        try:
            for field in (f for f in dataclasses.fields(self._type) if f.name in inner):  # type: ignore[arg-type]
                top[field.name] = _replaced(field, inner[field.name])
            return self._type(**top)
        except ArithmeticError as error:
            raise ParameterError(f"the values cannot be computed with: {error}") from error

    def _with(self, parameters: Iterable[Parameter]) -> dict[str, Any]:
        mine = (p for p in parameters if p.name in self._entries)
        new = {p.name: coerce(p.name, p.value, self._entries[p.name].default) for p in mine}
        return {**self._values, **new}

    def _validate(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            self._check(self._build(self._with(parameters)))
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _replace(self, parameters: list[Parameter]) -> None:
        values = self._with(parameters)
        if values == self._values:
            return
        self._values = values
        self.settings = self._build(values)
        if self._changed is not None:
            self._changed(self.settings)


def _replaced(field: dataclasses.Field[Any], parts: Mapping[str, Any]) -> Any:
    """Return nested settings with new values; what is refused is named as the parameters are."""
    try:
        return dataclasses.replace(field.default, **parts)
    except ParameterError as error:
        place = field.metadata["prefix"].rstrip(".")
        raise ParameterError(f"{place}: {error}" if place else str(error)) from None


def given_parameters(node: Node) -> dict[str, Any]:
    """Return what the command line, launch and parameter files set for a node."""
    return {name: parameter.value for name, parameter in node._parameter_overrides.items()}


def _descriptor(entry: _Entry) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=entry.description,
        read_only=entry.read_only,
        # Types are checked by `coerce`, which takes 1 for 1.0 and says what it wants.
        dynamic_typing=True,
    )
    if entry.limited and isinstance(entry.default, float):
        low, high = max(float(entry.minimum), -1.7e308), min(float(entry.maximum), 1.7e308)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif entry.limited:
        low, high = max(entry.minimum, -(2**31)), min(entry.maximum, 2**31 - 1)
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor
