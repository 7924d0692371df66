# SPDX-License-Identifier: Apache-2.0
"""Yield a bag's messages one by one in order of arrival, for a player."""

import heapq
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import yaml

from smp_motor_ident.bag.source import find_recordings
from smp_motor_ident.bag.storage import Batch, Channel
from smp_motor_ident.bag.unpack import decompress_messages
from smp_motor_ident.errors import BagError

Entry = tuple[int, int, Batch, int]


class Replay:
    """The messages of one bag: a folder or a bare file."""

    def __init__(self, path: Path) -> None:
        found = find_recordings(path)
        if len(found) > 1:
            names = ", ".join(recording.name for recording in found)
            raise BagError(f"{path}: holds several bags ({names}); name one")
        self._recording = found[0]
        if self._recording.is_table:
            raise BagError(f"{path}: is a table, not a bag")
        channels = self._recording.channels()
        self.channels = list({(c.topic, c.type): c for c in channels}.values())
        self.findings = self._recording.findings  # missing or damaged parts

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda _: True
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, log time [ns] and data in the order of the log times, chunk by chunk.

        Where chunks overlap by more than one, a late message comes late.
        """

        def message(entry: Entry) -> tuple[Channel, int, bytes]:
            time, _, batch, k = entry
            return batch.channel, time, batch.message(k)

        waiting: list[Entry] = []
        number = count()
        self._recording.findings.clear()
        for together in self._recording.batches(wanted):
            fresh: list[Entry] = []
            for packed in together:
                batch, _ = decompress_messages(packed, self._recording.budget)
                fresh += [
                    (t, next(number), batch, k) for k, t in enumerate(batch.log_time.tolist())
                ]
            if not fresh:
                continue
            begin = min(entry[0] for entry in fresh)
            while waiting and waiting[0][0] <= begin:
                yield message(heapq.heappop(waiting))
            waiting += fresh
            heapq.heapify(waiting)
        while waiting:
            yield message(heapq.heappop(waiting))


def find_offered_qos(channel: Channel) -> tuple[bool, bool]:
    """Return whether reliable and transient local messages were offered; reliable if unknown."""
    try:
        profiles = yaml.safe_load(channel.qos) if channel.qos else []
        reliability = {str(profile["reliability"]).lower() for profile in profiles}
        durability = {str(profile["durability"]).lower() for profile in profiles}
    except (yaml.YAMLError, TypeError, KeyError):
        return True, False
    best_effort = bool(reliability) and reliability <= {"2", "best_effort"}
    return not best_effort, bool(durability & {"1", "transient_local"})
