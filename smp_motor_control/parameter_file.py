"""YAML files that people write: ROS parameters and mappings, bounded before anything walks them."""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from smp_motor_control.errors import ParameterError, printable

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
        if not Path(path).is_file() and Path(path).exists():
            raise ParameterError(f"{path}: is not a file; give a file")
        with Path(path).open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise ParameterError(f"{path}: is larger than {MOST_BYTES:,} bytes; no parameter file")
        return bounded_yaml(data.decode("utf-8"), _Loader)
    except OSError as error:
        raise ParameterError(f"{path}: cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, ValueError, TypeError) as error:
        if isinstance(error, ParameterError):
            raise
        raise ParameterError(f"{path}: is not YAML: {' '.join(str(error).split())}") from None


def bounded_yaml(text: str, loader: Any) -> Any:
    """Return what a YAML text holds; YAMLError where that is too large before it is built."""
    total, sizes = 0, dict[str | None, int]()
    begun: list[tuple[str | None, int]] = []
    for event in yaml.parse(text, loader):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = begun.pop()
            sizes[anchor] = total - before
        elif isinstance(event, yaml.AliasEvent):
            total += sizes.get(event.anchor, 1)
        elif isinstance(event, yaml.NodeEvent):
            total += 1
            sizes[event.anchor] = 1
            if isinstance(event, yaml.CollectionStartEvent):
                begun.append((event.anchor, total))
                sizes[event.anchor] = MOST_NODES  # until it ends: inside itself it has no end
        if len(begun) > MOST_LEVELS:
            raise yaml.YAMLError(f"nested more than {MOST_LEVELS} levels deep")
        if total > MOST_NODES:
            raise yaml.YAMLError(f"holds more than {MOST_NODES:,} values, each alias counted whole")
    return yaml.load(text, loader)


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
    return "".join(f"# {printable(line)}\n" for line in head) + yaml.safe_dump(
        tree, sort_keys=False
    )


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
