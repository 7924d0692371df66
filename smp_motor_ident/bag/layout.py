"""Decoding in bulk: one template reads all messages of the same layout at once.

The position of a number depends on nothing but the lengths of the strings and sequences
before it: messages of one topic that agree in these have their numbers at the same places, and
one indexing per field reads them all.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import tee
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.bag.storage import Batch, Channel, gather
from smp_motor_ident.bag.template import DecodeError, Number, Text, locate, parse_path, take_apart
from smp_motor_ident.bag.types import Definitions
from smp_motor_ident.errors import BagError

Part = tuple[NDArray[np.int64], list[NDArray[Any] | None]]
"""Which messages of a batch agree, and their columns; a column is None where they have none."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the wanted numbers lie in all messages that agree with one template."""

    length: int
    checks: tuple[tuple[int, int], ...]
    numbers: tuple[Number | None, ...]

    def matches(self, batch: Batch) -> NDArray[np.bool_]:
        """Return which messages have this layout."""
        same: NDArray[np.bool_] = np.equal(batch.length, self.length)
        for offset, word in self.checks:
            if not same.any():
                return same
            at = np.where(same, batch.offset, batch.offset[int(np.argmax(same))])
            same &= gather(batch.data, at + offset, "<u4") == word
        return same


class Decoder:
    """Reads the wanted fields of one channel, by the first candidate that fits a message."""

    KEPT = 64

    def __init__(
        self, channel: Channel, candidates: Iterable[Definitions], paths: Sequence[str]
    ) -> None:
        self.name = channel.type
        self._encoding = channel.encoding
        self.paths = tuple(paths)
        self._steps = [parse_path(path) for path in paths]
        self._candidates = iter(candidates)
        self._layouts: list[Layout] = []
        self.undecodable = 0
        self.reason = ""

    def decode(self, batch: Batch) -> list[Part]:
        """Decode a batch; messages that are no such messages are missing and counted."""
        parts: list[Part] = []
        left: NDArray[np.int64] = np.arange(len(batch))
        while left.size:
            rest = batch.take(left)
            for layout in self._layouts:
                if (same := layout.matches(rest)).any():
                    parts.append((left[same], _read(rest, same, layout)))
                    left = left[~same]
                    rest = batch.take(left)
                if not left.size:
                    break
            if left.size and not self._learn(rest.message(0)):
                self.undecodable += 1
                left = left[1:]
        return parts

    def _learn(self, data: bytes) -> bool:
        """Take a message as template; False where it cannot be taken apart."""
        # None is looked for before the others have failed.
        self._candidates, candidates = tee(self._candidates)
        for definitions in candidates:
            try:
                template = take_apart(data, self.name, definitions, self._encoding)
                break
            except DecodeError as error:
                self.reason = self.reason or str(error)
        else:
            return False
        self._candidates = iter([definitions])
        numbers: list[Number | None] = []
        texts: list[Text] = []
        for path, steps in zip(self.paths, self._steps):
            try:
                number, used = locate(template, steps)
            except BagError as error:
                raise BagError(f"{self.name}: field {path!r} {error}") from None
            numbers.append(number)
            texts += used
        # Everything up to the last wanted number must have the template's lengths; beyond
        # it, the message's whole length is enough.
        last = max((n.offset for n in numbers if n is not None), default=len(data))
        positions = {at for at in template.lengths if at < last}
        for text in texts:
            positions.update(range(text.begin, max(text.end - 3, text.begin + 1), 4))
            if text.end - text.begin > 4:
                positions.add(text.end - 4)
        words = tuple((at, int.from_bytes(data[at : at + 4], "little")) for at in sorted(positions))
        self._layouts.insert(0, Layout(len(data), words, tuple(numbers)))
        del self._layouts[self.KEPT :]
        return True


def _read(batch: Batch, which: NDArray[np.bool_], layout: Layout) -> list[NDArray[Any] | None]:
    """Return the columns of the messages that have the layout."""
    offset = batch.offset if which.all() else batch.offset[which]
    return [
        None if number is None else gather(batch.data, offset + number.offset, number.kind)
        for number in layout.numbers
    ]
