"""Fields of settings that say what they are, to people and as parameters of nodes."""

from dataclasses import field
from typing import Any


def described(default: Any, description: str, **more: Any) -> Any:
    """Return a field of a dataclass with a description, and what else is to be known of it."""
    return field(default=default, metadata={"description": description, **more})
