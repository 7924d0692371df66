# SPDX-License-Identifier: Apache-2.0
"""YAML files of bounded size: ROS parameters and mappings."""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from smp_motor_control.errors import ParameterError, printable

MAX_BYTES = 1_000_000  # maximum size of a file; parsing takes some 10 s per megabyte

MAX_NODES = 100_000
"""Maximum number of values, with aliases expanded: ten lines can expand to 10^9 values."""

MAX_DEPTH = 32  # maximum depth of nesting


class _Loader(yaml.SafeLoader):
    """YAML loader that reads ``1e-6`` as a number, as ROS does."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+\Z"),
    list("-+0123456789."),
)


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file within the limits of this module."""
    try:
        if not Path(path).is_file() and Path(path).exists():
            raise ParameterError(f"{path}: is not a file; give the path of a YAML file")
        with Path(path).open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ParameterError(f"{path}: is larger than {MAX_BYTES:,} bytes; give another file")
        return load_bounded_yaml(data.decode("utf-8"), _Loader)
    except OSError as error:
        raise ParameterError(f"{path}: cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, ValueError, TypeError) as error:
        if isinstance(error, ParameterError):
            raise
        raise ParameterError(f"{path}: is not YAML: {' '.join(str(error).split())}") from None


def load_bounded_yaml(text: str, loader: Any) -> Any:
    """Return the content of a YAML text; raise YAMLError if it is too large to build."""
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
                sizes[event.anchor] = MAX_NODES  # an alias inside its own anchor never ends
        if len(begun) > MAX_DEPTH:
            raise yaml.YAMLError(f"nested more than {MAX_DEPTH} levels deep")
        if total > MAX_NODES:
            raise yaml.YAMLError(f"holds more than {MAX_NODES:,} values, each alias counted whole")
    return yaml.load(text, loader)


def read_parameters(path: str | Path) -> dict[str, dict[str, Any]]:
    """Read a ROS parameter file."""
    document = read_yaml(path)
    if not isinstance(document, Mapping) or not document:
        raise ParameterError(
            f"{path}: is not a ROS parameter file; give a file with NODE: ros__parameters: ..."
        )
    return dict(_nodes(document, "", path))


def _nodes(level: Mapping[Any, Any], place: str, path: str | Path) -> Iterator[tuple[str, Any]]:
    """Yield the nodes of a level, which may be a namespace."""
    for name, entry in level.items():
        node = f"{place}/{str(name).strip('/')}"
        inside = entry if isinstance(entry, Mapping) else {}
        if isinstance(parameters := inside.get("ros__parameters"), Mapping):
            yield node, flatten(parameters)
        elif inside and "ros__parameters" not in inside:
            yield from _nodes(inside, node, path)
        else:
            raise ParameterError(
                f"{path}: {node} has no ros__parameters; give a ROS parameter file"
            )


def format_parameters(nodes: Mapping[str, Mapping[str, Any]], head: Iterable[str] = ()) -> str:
    """Return the text of a ROS parameter file, with ``head`` as comments."""
    tree = {node: {"ros__parameters": dict(parameters)} for node, parameters in nodes.items()}
    return "".join(f"# {printable(line)}\n" for line in head) + yaml.safe_dump(
        tree, sort_keys=False
    )


def read_node_parameters(path: str | Path, node: str) -> dict[str, Any]:
    """Read the parameters of all nodes with a name, in any namespace."""
    found: dict[str, Any] = {}
    for name, parameters in read_parameters(path).items():
        found.update(parameters if name.rpartition("/")[2] in (node, "*", "**") else {})
    return found


def flatten(tree: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested parameters by their dotted names, such as ``{"model.delay": 0.0}``."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        inner = isinstance(value, Mapping)
        found.update(flatten(value, f"{prefix}{name}.") if inner else {f"{prefix}{name}": value})
    return found


def require_nodes(path: str | Path, nodes: Iterable[str]) -> None:
    """Raise when a parameter file has no entry for a node, which would run on defaults."""
    names = list(read_parameters(path))
    patterns = [
        re.escape(name).replace(r"/\*\*", r"(/\w+)*").replace(r"\*", r"\w+") for name in names
    ]
    alone = [node for node in nodes if not any(re.fullmatch(one, node) for one in patterns)]
    if alone:
        raise ParameterError(
            f"{path}: has no parameters for {', '.join(alone)}; it has those of {', '.join(names)}"
        )
