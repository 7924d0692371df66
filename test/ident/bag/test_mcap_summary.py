# SPDX-License-Identifier: Apache-2.0
"""The summary of an MCAP file: its schemas, channels, message counts and chunks."""

import struct
import subprocess
import sys

import mcap.writer
import pytest
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from recordings import merged, motion, write_mcap

from smp_motor_ident.bag import read_records
from smp_motor_ident.bag.readers.mcap import read_summary
from smp_motor_ident.errors import BagError

ZSTD = mcap.writer.CompressionType.ZSTD


@pytest.mark.parametrize(
    "options",
    [
        dict(),
        dict(compression=ZSTD),
        dict(use_chunking=False),
        dict(use_summary_offsets=False, use_statistics=True),
        dict(repeat_channels=False),
        dict(use_statistics=False),
        dict(index_types=mcap.writer.IndexType.NONE),
    ],
    ids=str,
)
def test_summary_equals_that_of_mcap_library(tmp_path, options):
    messages = merged(motion(n=100), motion(n=70, wheel="rear_right", seed=2))
    path = write_mcap(tmp_path / "bag.mcap", messages, **options)
    with path.open("rb") as file:
        found = read_summary(file)
        file.seek(0)
        theirs = SeekingReader(file).get_summary()
    complete = theirs.statistics is not None and len(theirs.channels) == 4
    assert (found is not None) == complete
    if found is not None:
        assert {key: tuple(fields) for key, *fields, _ in found[Opcode.SCHEMA]} == {
            s.id: (s.name, s.encoding, s.data) for s in theirs.schemas.values()
        }
        assert {key: tuple(fields) for key, *fields, _ in found[Opcode.CHANNEL]} == {
            c.id: (c.schema_id, c.topic, c.message_encoding, c.metadata)
            for c in theirs.channels.values()
        }
        assert found[Opcode.STATISTICS][-1][-2] == theirs.statistics.channel_message_counts
        assert {start: offsets for _, _, start, _, offsets, *_ in found[Opcode.CHUNK_INDEX]} == {
            c.chunk_start_offset: c.message_index_offsets for c in theirs.chunk_indexes
        }
    assert len(read_records(path)["rear_right"]) == 70


def test_damage_to_any_byte_of_the_summary_loses_no_message_silently(tmp_path):
    path = write_mcap(tmp_path / "bag.mcap", motion(n=60).messages(), defined=False)
    whole = path.read_bytes()
    (begin,) = struct.unpack_from("<Q", whole, len(whole) - 28)  # the footer's summary_start
    for at in range(begin, len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x41]) + whole[at + 1 :])
        try:
            record = read_records(path)["front_left"]
        except BagError as error:
            told = str(error)
        else:
            told = " ".join(finding.message for finding in record.findings)
            if len(record) == 60:
                continue
        assert path.name in told, at


def test_compressed_bags_are_read_without_the_package_mcap(tmp_path):
    path = write_mcap(tmp_path / "bag.mcap", motion(n=60).messages(), compression=ZSTD)
    program = (
        "import sys\nsys.modules['mcap'] = sys.modules['zstandard'] = None\n"
        "from smp_motor_ident.bag import read_records\n"
        "assert len(read_records(sys.argv[1])['front_left']) == 60\n"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=True)
