# SPDX-License-Identifier: Apache-2.0
"""Folders of bags, and bags of several files, as recordings or experiments."""

import pytest
from recordings import (
    assert_read,
    assert_refused,
    motion,
    notes,
    read_one,
    write_file,
    write_metadata,
)

from smp_motor_ident.bag import read_experiments
from smp_motor_ident.errors import BagError


@pytest.mark.parametrize("storage", ["mcap", "db3"])
@pytest.mark.parametrize("described", [True, False])
def test_split_bags_are_one_recording(tmp_path, storage, described):
    truth, bag = motion(n=300), tmp_path / "bag"
    messages = truth.messages()
    # More than ten files: alphabetical order would be wrong.
    parts = [messages[k * 26 : (k + 1) * 26] for k in range(12)]
    files = [write_file(bag / f"bag_{k}.{storage}", part).name for k, part in enumerate(parts)]
    if described:
        write_metadata(bag, files, messages)
    record = read_one(bag)
    assert_read(record, truth)
    assert record.starts == (0,)
    assert ("metadata.yaml" in notes(record)) is not described


def test_missing_part_of_split_bag_is_reported_with_lost_messages(tmp_path):
    truth, bag = motion(n=300), tmp_path / "bag"
    messages = truth.messages()
    write_file(bag / "bag_0.mcap", messages[:101])
    write_metadata(bag, ["bag_0.mcap", "bag_1.mcap"], messages)
    record = read_one(bag)
    assert_read(record, truth, 100)
    assert "bag_1.mcap is missing" in notes(record)
    assert "100 of 300 messages" in notes(record)


def test_damaged_part_of_split_bag_loses_only_its_messages(tmp_path):
    messages, bag = motion(n=300).messages(), tmp_path / "bag"
    write_file(bag / "bag_0.mcap", messages[:101])
    (bag / "bag_1.mcap").write_bytes(b"")
    write_file(bag / "bag_2.mcap", messages[201:])
    write_metadata(bag, [f"bag_{k}.mcap" for k in range(3)], messages)
    record = read_one(bag)
    assert len(record) == 200
    assert record.starts == (0, 100)
    assert "bag_1.mcap: is empty" in notes(record)
    assert "200 of 300 messages" in notes(record)


def test_bags_in_a_folder_are_separate_experiments(tmp_path):
    truths = [motion(n=50 + k, seed=k) for k in range(3)]
    for k, truth in enumerate(truths):
        bag = tmp_path / f"run{k}"
        write_file(bag / "x_0.db3", truth.messages())
        write_metadata(bag, ["x_0.db3"], truth.messages())
    experiments = read_experiments(tmp_path)["front_left"]
    assert [len(record) for record in experiments] == [50, 51, 52]
    joined = read_one(tmp_path)
    assert joined.starts == (0, 50, 101)
    assert len(joined) == 153
    assert joined.source == "run0, run1, run2"


def test_differently_named_files_in_a_folder_are_separate_experiments(tmp_path):
    for name in ("slow.mcap", "fast.mcap"):
        write_file(tmp_path / name, motion(n=20).messages())
    assert [r.source for r in read_experiments(tmp_path)["front_left"]] == [
        f"{tmp_path.name}/fast",
        f"{tmp_path.name}/slow",
    ]


def test_fewer_messages_than_in_metadata_are_reported(tmp_path):
    messages, bag = motion().messages(), tmp_path / "bag"
    write_file(bag / "bag_0.db3", messages)
    write_metadata(bag, ["bag_0.db3"], messages, counts={"/front_left/motor_state": 1234})
    assert "200 of 1234 messages could be read" in notes(read_one(bag))


def test_missing_path_and_empty_folder_are_refused(tmp_path):
    assert_refused("does not exist", tmp_path / "nothing")
    assert_refused("holds no bag", tmp_path)


def test_unreadable_bag_in_a_folder_is_reported(tmp_path):
    for name in ("good", "bad"):
        write_file(tmp_path / name / "x_0.mcap", motion(n=20).messages())
    (tmp_path / "bad" / "x_0.mcap").write_bytes(b"")
    records = read_experiments(tmp_path)["front_left"]
    assert [len(record) for record in records] == [20]
    assert "not read:" in notes(records[0])
    assert "is empty" in notes(records[0])
    with pytest.raises(BagError, match="is empty"):
        read_experiments([tmp_path / "good", tmp_path / "bad"])


@pytest.mark.parametrize("text", ["", ":\n - {", "a: 1", "rosbag2_bagfile_information: 7"])
def test_files_are_read_when_metadata_is_damaged(tmp_path, text):
    truth = motion()
    write_file(tmp_path / "x_0.mcap", truth.messages())
    (tmp_path / "metadata.yaml").write_text(text)
    record = read_one(tmp_path)
    assert_read(record, truth)
    assert "metadata.yaml is damaged" in notes(record)
