# SPDX-License-Identifier: Apache-2.0
"""Yield a bag's messages one by one in order of arrival, for a player."""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path

import yaml

from smp_motor_ident.bag.source import find_recordings
from smp_motor_ident.bag.storage import Batch, Channel
from smp_motor_ident.bag.unpack import decompress_messages
from smp_motor_ident.errors import BagError

Entry = tuple[int, Batch, int]


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

        waiting: list[Entry] = []
        self._recording.findings.clear()
        for together in self._recording.batches(wanted):
            plain = [decompress_messages(packed, self._recording.budget)[0] for packed in together]
            fresh = [
                (t, batch, k) for batch in plain for k, t in enumerate(batch.log_time.tolist())
            ]
            begin = min((time for time, _, _ in fresh), default=-math.inf)
            due = bisect_right(waiting, begin, key=itemgetter(0))
            yield from map(_read_message, waiting[:due])
            waiting = sorted(waiting[due:] + fresh, key=itemgetter(0))
        yield from map(_read_message, waiting)


def _read_message(entry: Entry) -> tuple[Channel, int, bytes]:
    time, batch, k = entry
    return batch.channel, time, batch.message(k)


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
