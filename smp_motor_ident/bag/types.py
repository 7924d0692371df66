# SPDX-License-Identifier: Apache-2.0
"""Message definitions: from the bag, from the user's .msg files, from ROS, from rosbags."""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

from rosbags import typesys
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_typestore

from smp_motor_ident.bag.storage import Channel, first_line, message_type
from smp_motor_ident.errors import BagError
from smp_motor_ident.limits import MAX_DEFINITION_SIZE

Fields = Sequence[tuple[str, Any]]
Definitions = Mapping[str, Fields]
"""Fields of every message type by its full name; the field's description is rosbags'."""
Lookup = Callable[[str], Fields | None]
"""Function from the full name of a type to its fields; None if unknown."""

_STORES = (Stores.ROS2_JAZZY, Stores.ROS2_HUMBLE, Stores.ROS2_FOXY, Stores.ROS2_DASHING)
_DAMAGE = (TypesysError, BagError, ValueError, LookupError, TypeError, RecursionError)
_DIVIDER = "=" * 80 + "\n"


@lru_cache(maxsize=512)
def _parse(text: str, name: str, form: str) -> dict[str, Fields]:
    """Return the fields of all messages that a definition text holds."""
    text = "\n".join(filter(str.strip, text.splitlines()))  # many empty lines would take hours
    if len(text) > MAX_DEFINITION_SIZE:
        raise BagError(
            f"its definition has {len(text)} characters, more than {MAX_DEFINITION_SIZE:.0f}"
        )
    if form == "ros2idl" or text.startswith(_DIVIDER + "IDL: "):
        types: dict[str, Any] = {}
        parts = text.split(_DIVIDER)[1:] if text.startswith(_DIVIDER) else [f"IDL:\n{text}"]
        for part in parts:
            types.update(typesys.get_types_from_idl(part.partition("\n")[2]))
    else:
        types = dict(typesys.get_types_from_msg(text, name))
    return {key: fields for key, (_, fields) in types.items()}


def _references(fields: Fields) -> Iterator[str]:
    for _, description in fields:
        kind, detail = description
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            kind, detail = detail[0]
        if kind == Nodetype.NAME:
            yield detail


@cache
def _find_stored(which: Stores, name: str) -> Fields | None:
    """Return a type of a distribution, whose types are loaded when one is asked for."""
    found = get_typestore(which).fielddefs.get(name)
    return None if found is None else found[1]


def _find_installed_file(name: str, suffix: str) -> Path | None:
    """Return a file of an installed interface package, such as its ``.msg``."""
    package, _, kind = name.split("/")
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, "share", package, "msg", kind + suffix)
        if prefix and path.is_file():
            return path
    return None


class Types:
    """Definitions of message types; ``files`` are the user's ``.msg`` files or folders."""

    def __init__(self, files: Iterable[str | os.PathLike[str]] = ()) -> None:
        self._given: dict[str, Fields] = {}
        self._seen: set[str] = set()
        self._left = 3 * MAX_DEFINITION_SIZE
        for given in files:
            path = Path(given)
            inside = path.rglob("*.msg") if path.is_dir() else [path]
            if not (found := sorted(filter(Path.is_file, inside))):
                raise BagError(f"{path}: no .msg file there")
            for file in found:
                folder = file.resolve().parent
                name = f"{(folder.parent if folder.name == 'msg' else folder).name}/msg/{file.stem}"
                try:
                    self._given.update(_parse(file.read_text(), name, "ros2msg"))
                except (TypesysError, OSError, ValueError, RecursionError) as error:
                    reason = f"not a message definition ({first_line(error)})"
                    raise BagError(f"{file}: {reason}") from None

    def candidates(self, channel: Channel) -> Iterator[Definitions]:
        """Yield possible definitions of the channel's type, the most trusted first; at least one.

        Several distributions changed messages without changing their name; where a bag
        does not define its types, the one that fits the bytes is right.
        """
        name, reasons = channel.type, []
        stores: list[Lookup] = [partial(_find_stored, which) for which in _STORES]
        if channel.definition:
            try:
                self._count_definition(channel.definition)
                own = _parse(channel.definition, name, channel.definition_format)
                yield self._resolve_references(name, [own.get, self._given.get, *stores])
            except _DAMAGE as error:
                reasons.append(f"the bag's own definition cannot be used: {first_line(error)}")
        given: list[Lookup] = [self._find_by_last_name(name).get, self._given.get]
        known = [[_find_installed, stores[0]], *([store, _find_installed] for store in stores[1:])]
        for sources in known:
            try:
                yield self._resolve_references(name, [*given, *sources])
            except (TypesysError, BagError) as error:
                reasons.append(first_line(error))
        if len(reasons) == len(known) + bool(channel.definition):
            raise BagError(
                f"{channel.topic}: the message type {name or '(none)'!r} is unknown "
                f"({reasons[0]}); give its definition as .msg files"
            )

    def _count_definition(self, text: str) -> None:
        """Refuse definitions that are too long together."""
        self._left -= 0 if text in self._seen else len(text)
        self._seen.add(text)
        if self._left < 0:
            raise BagError(f"definitions have more than {3 * MAX_DEFINITION_SIZE:.0f} characters")

    def _find_by_last_name(self, name: str) -> dict[str, Fields]:
        """Return a definition by the type's last name where the user's folder says no package."""
        if name in self._given:
            return {}
        same = [key for key in self._given if key.rpartition("/")[2] == name.rpartition("/")[2]]
        return {name: self._given[same[0]]} if len(same) == 1 else {}

    def _resolve_references(self, name: str, sources: Sequence[Lookup]) -> Definitions:
        """Return the type and all that it refers to, each from the first source that has it."""
        closed: dict[str, Fields] = {}
        open_names = [name]
        while open_names:
            key = open_names.pop()
            if key in closed:
                continue
            fields = next((f for source in sources if (f := source(key)) is not None), None)
            if fields is None:
                raise BagError(f"nothing defines {key!r}")
            closed[key] = fields
            open_names.extend(_references(fields))
        return closed


def _find_installed(name: str) -> Fields | None:
    """Return a type of the interface packages on AMENT_PREFIX_PATH."""
    return None if (text := _read_msg_file(name)) is None else _parse(text, name, "")[name]


@cache
def _read_msg_file(name: str) -> str | None:
    if name.count("/") != 2:
        return None
    path = _find_installed_file(name, ".msg")
    return path.read_text() if path else None


def definition(name: str) -> tuple[str, str]:
    """Return definition and REP-2011 hash of a message type, as rosbag2 writes them."""
    name = message_type(name)
    types = Types()
    closed = next(types.candidates(Channel(0, name, name)))
    texts = {key: _read_msg_file(key) for key in closed}
    if all(text is not None for text in texts.values()):
        whole = [texts.pop(name) or ""]
        whole += [f"MSG: {key.replace('/msg/', '/')}\n{text}" for key, text in texts.items()]
        text = ("\n" + _DIVIDER).join(whole)
        if (path := _find_installed_file(name, ".json")) is not None:
            hashes = json.loads(path.read_text())["type_hashes"]
            own = [h["hash_string"] for h in hashes if h["type_name"] == name]
            if own:
                return text, own[0]
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register({k: ([], list(v)) for k, v in closed.items() if k not in store.fielddefs})
    return store.generate_msgdef(name, ros_version=2)[0], store.hash_rihs01(name)
