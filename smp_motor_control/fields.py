# SPDX-License-Identifier: Apache-2.0
"""Dataclass fields with descriptions and limits, from which nodes declare their parameters.

Settings are frozen dataclasses and may be nested.  A parameter's name is that of its field (or
``name``), after the prefixes of the settings that contain it.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from smp_motor_control.errors import ParameterError, check_range

S = TypeVar("S")


class Described(NamedTuple):
    """Description of one parameter."""

    default: Any
    text: str
    minimum: float = -math.inf
    maximum: float = math.inf
    read_only: bool = False
    name: str = ""
    zero_is_infinite: bool = False  # whether a parameter of 0 means infinity

    @property
    def limited(self) -> bool:
        """Whether the number has a limit."""
        return math.isfinite(self.minimum) or math.isfinite(self.maximum)


class _Nested(NamedTuple):
    kind: type
    prefix: str
    needs: Sequence[str] = ()


def described(default: Any, description: str, **more: Any) -> Any:
    """Return a field with a description; ``more`` are attributes of :class:`Described`."""
    return dataclasses.field(
        default=default, metadata={"": Described(default, description, **more)}
    )


def fixed(default: Any, description: str, **more: Any) -> Any:
    """Return a field as :func:`described`, for a read-only parameter."""
    return described(default, description, read_only=True, **more)


def nested(default: Any, *, prefix: str = "") -> Any:
    """Return a field that holds other settings."""
    return dataclasses.field(default=default, metadata={"": _Nested(type(default), prefix)})


def optional(kind: type, *needs: str, prefix: str) -> Any:
    """Return a field of settings that are None while the parameters ``needs`` are 0 (default)."""
    return dataclasses.field(default=None, metadata={"": _Nested(kind, prefix, needs)})


def parameters_in(settings: type, default: Any = None, prefix: str = "") -> dict[str, Described]:
    """Return the parameters of settings by name; ``default`` is an instance with their defaults."""
    found = {}
    for field, known in _described_fields(settings):
        value = field.default if default is None else getattr(default, field.name)
        if isinstance(known, Described):
            known = known._replace(default=value)
            if known.zero_is_infinite:
                shown = 0.0 if math.isinf(value) else value
                known = known._replace(default=shown, text=f"{known.text.rstrip('.')}; 0 for none.")
            found[prefix + (known.name or field.name)] = known
            continue
        inside = prefix + known.prefix
        for name, one in parameters_in(known.kind, value, inside).items():
            found[name] = one._replace(default=0.0, minimum=0.0) if known.needs else one
    return found


def build_settings(settings: type[S], values: Mapping[str, Any], prefix: str = "") -> S:
    """Build settings from the values of their parameters; errors name the prefix."""
    given: dict[str, Any] = {}
    for field, known in _described_fields(settings):
        if isinstance(known, Described):
            value = values[prefix + (known.name or field.name)]
            given[field.name] = value or math.inf if known.zero_is_infinite else value
            continue
        inside = prefix + known.prefix
        there = [bool(values[inside + name]) for name in known.needs]
        if any(there) and not all(there):
            needed = " and ".join(inside + name for name in known.needs)
            raise ParameterError(f"only one of {needed} is given; give both")
        if all(there):
            given[field.name] = _build_nested(known, values, inside)
    return settings(**given)


def check_limits(settings: Any) -> None:
    """Raise for a number beyond the limits of its description."""
    for field, known in _described_fields(settings):
        if isinstance(known, Described) and known.limited:
            check_range(field.name, getattr(settings, field.name), known.minimum, known.maximum)


def _build_nested(known: _Nested, values: Mapping[str, Any], prefix: str) -> Any:
    try:
        return build_settings(known.kind, values, prefix)
    except ParameterError as error:
        if not known.prefix or known.needs:
            raise
        raise ParameterError(f"{prefix.rstrip('.')}: {error}") from None


def _described_fields(settings: Any) -> Iterator[tuple[Any, Described | _Nested]]:
    for field in dataclasses.fields(settings):
        if "" in field.metadata:
            yield field, field.metadata[""]
