"""YAML files that people write: ROS parameters and mappings, bounded before anything walks them."""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from smp_motor_control.errors import ParameterError

MOST_BYTES = 1_000_000
"""Parsing takes some 10 s per megabyte; a robot's parameter file has a few kilobytes."""

MOST_NODES = 100_000
"""Aliases count each time they are met, so that ten lines cannot stand for 10^9 values."""

MOST_LEVELS = 32
"""ROS parameters nest by their dots; nobody writes a name of 32 parts."""


class _Loader(yaml.SafeLoader):
    """YAML with the numbers of ROS: ``1e-6`` is one, not text."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+\Z"),
    list("-+0123456789."),
)


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file of bounded size and depth."""
    try:
        with Path(path).open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise ParameterError(f"{path}: is larger than {MOST_BYTES:,} bytes; no parameter file")
        document = yaml.load(data.decode("utf-8"), Loader=_Loader)
    except OSError as error:
        raise ParameterError(f"{path}: cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, ValueError, TypeError) as error:
        if isinstance(error, ParameterError):
            raise
        raise ParameterError(f"{path}: is not YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise ParameterError(f"{path}: is nested more than {MOST_LEVELS} levels deep") from None
    _check_size(document, path)
    return document


def _check_size(document: Any, path: str | Path) -> None:
    pending, nodes = [(document, 0)], 0
    while pending:
        value, level = pending.pop()
        nodes += 1
        if level > MOST_LEVELS:
            raise ParameterError(f"{path}: is nested more than {MOST_LEVELS} levels deep")
        if nodes > MOST_NODES:
            raise ParameterError(f"{path}: holds more than {MOST_NODES:,} values")
        if isinstance(value, Mapping):
            pending.extend((inner, level + 1) for inner in value.values())
        elif isinstance(value, list):
            pending.extend((inner, level + 1) for inner in value)


def read_parameters(path: str | Path) -> dict[str, dict[str, Any]]:
    """Read a ROS parameter file."""
    document = read_yaml(path)
    if not isinstance(document, Mapping) or not document:
        raise ParameterError(f"{path}: is no ROS parameter file: expected node names with values")
    return dict(_nodes(document, "", path))


def _nodes(level: Mapping[Any, Any], place: str, path: str | Path) -> Iterator[tuple[str, Any]]:
    """Yield the nodes of a level; namespaces may be levels."""
    for name, entry in level.items():
        node = f"{place}/{str(name).strip('/')}"
        inside = entry if isinstance(entry, Mapping) else {}
        if isinstance(parameters := inside.get("ros__parameters"), Mapping):
            yield node, flat(parameters)
        elif inside and "ros__parameters" not in inside:
            yield from _nodes(inside, node, path)
        else:
            raise ParameterError(f"{path}: {node}: is no ROS parameter file: no ros__parameters")


def written(nodes: Mapping[str, Mapping[str, Any]], head: Iterable[str] = ()) -> str:
    """Return the text of a ROS parameter file, behind comments."""
    tree = {node: {"ros__parameters": dict(parameters)} for node, parameters in nodes.items()}
    return "".join(f"# {line}\n" for line in head) + yaml.safe_dump(tree, sort_keys=False)


def parameters_of(path: str | Path, node: str) -> dict[str, Any]:
    """Return what a parameter file says to the nodes of a name, in whatever namespace."""
    found: dict[str, Any] = {}
    for name, parameters in read_parameters(path).items():
        found.update(parameters if name.rpartition("/")[2] in (node, "*", "**") else {})
    return found


def flat(tree: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested parameters by their ROS names, such as ``{"model.delay": 0.0}``."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        inner = isinstance(value, Mapping)
        found.update(flat(value, f"{prefix}{name}.") if inner else {f"{prefix}{name}": value})
    return found


def require_nodes(path: str | Path, nodes: Iterable[str]) -> None:
    """Refuse a parameter file that says nothing to a node: it would run on its defaults."""
    names = list(read_parameters(path))
    patterns = [
        re.escape(name).replace(r"/\*\*", r"(/\w+)*").replace(r"\*", r"\w+") for name in names
    ]
    alone = [node for node in nodes if not any(re.fullmatch(one, node) for one in patterns)]
    if alone:
        raise ParameterError(
            f"{path}: says nothing to {', '.join(alone)}; it has {', '.join(names)}"
        )
