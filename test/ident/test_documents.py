# SPDX-License-Identifier: Apache-2.0
"""Result documents: round trip, refusal of damaged files, atomic writing."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from results import PHYSICAL, estimate

from smp_motor_control.parameter_file import read_parameters
from smp_motor_ident.errors import BagError, ParameterError
from smp_motor_ident.report.document import (
    identification_document,
    motors_yaml,
    read_identification,
    write_together,
)
from smp_motor_ident.result import Estimate, Quantity


def test_document_reads_back_as_the_same_estimates(tmp_path):
    wheels = {"front_left": estimate(), "rear_left": estimate("rear_left", current=False)}
    path = tmp_path / "identification.json"
    path.write_text(json.dumps(identification_document(wheels), allow_nan=False))
    again = read_identification(tmp_path)
    assert identification_document(again) == identification_document(wheels)


def test_motors_file_states_combinations_where_parameters_are_unknown():
    wheels = {"front_left": estimate(), "rear_left": estimate("rear_left", current=False)}
    text = motors_yaml(wheels, ["from a bag"])
    motors = yaml.safe_load(text)["/**/motor_plant"]["ros__parameters"]["motors"]
    assert text.startswith("# from a bag\n")
    assert motors["front_left"]["inertia"] == PHYSICAL["inertia"][0]
    assert "dc_gain" not in motors["front_left"]
    assert motors["rear_left"]["dc_gain"] == 25.5
    assert "inertia" not in motors["rear_left"]
    assert motors["rear_left"]["gear_ratio"] == 65.5


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "is not JSON"), ("[" * 100_000, "is not JSON"),
        ('{"schema": 1, "motors": ' + '{"a":' * 100_000, "is not JSON"),
        ("[]", "schema"), ('{"schema": 1, "motors": {"a": {}}}', "damaged"),
    ],
)  # fmt: skip
def test_damaged_document_is_refused_with_file_and_reason(tmp_path, text, reason):
    path = tmp_path / "identification.json"
    path.write_text(text)
    with pytest.raises(BagError, match=reason) as error:
        read_identification(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("junk", [None, True, -1, 1e308, 10**400, "x", [], {}, [[]], {"a": {}}])
def test_document_with_any_value_replaced_is_read_or_refused_in_one_line(tmp_path, junk):
    whole = json.dumps(identification_document({"w": estimate()}))

    def places(node: object, way: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in items:
            yield (*way, key)
            if isinstance(value, (dict, list)):
                yield from places(value, (*way, key))

    path = tmp_path / "identification.json"
    for *way, last in places(json.loads(whole)):
        document = node = json.loads(whole)
        for key in way:
            node = node[key]
        node[last] = junk
        path.write_text(json.dumps(document))
        said = f"{path}: read"
        try:
            read_identification(path)
        except BagError as error:
            said = str(error)
        assert said.startswith(f"{path}: ")
        assert "\n" not in said


@pytest.mark.parametrize("name", ['a*/\nsystem("x"); //', "a b", "1a", "", "a/", "ä", "../a"])
def test_wheel_with_invalid_ros_name_is_refused(tmp_path, name):
    path = tmp_path / "identification.json"
    path.write_text(json.dumps(identification_document({name: estimate()})))
    with pytest.raises(BagError, match="has no ROS name"):
        read_identification(path)


def test_control_characters_in_document_texts_are_replaced(tmp_path):
    document = identification_document({"w": estimate()})
    document["motors"]["w"]["sources"] = ["bag\n#define K_P 0\x1b[2J"]
    (tmp_path / "identification.json").write_text(json.dumps(document))
    assert read_identification(tmp_path)["w"].sources == ("bag\ufffd#define K_P 0\ufffd[2J",)


@pytest.mark.parametrize("name", ["frequency", "shown", "bound"])
def test_model_error_lists_of_unequal_length_are_refused(tmp_path, name):
    error = {"frequency": [1.0, 2.0], "shown": [0.1, 0.1], "bound": [0.2, 0.2]}
    document = identification_document({"w": estimate()})
    document["motors"]["w"]["residuals"]["model_error"] = {**error, name: [1.0]}
    (tmp_path / "identification.json").write_text(json.dumps(document))
    with pytest.raises(BagError, match="model_error has lists of"):
        read_identification(tmp_path)


def test_named_pipes_are_refused_without_blocking(tmp_path):
    os.mkfifo(tmp_path / "identification.json")
    with pytest.raises(BagError, match="is not a file"):
        read_identification(tmp_path)
    with pytest.raises(ParameterError, match="is not a file"):
        read_parameters(tmp_path / "identification.json")


def test_parameter_file_with_exponential_yaml_aliases_is_refused(tmp_path):
    inner = (",".join([f"*a{k - 1}" if k else "1"] * 10) for k in range(9))
    text = "".join(f"a{k}: &a{k} [{one}]\n" for k, one in enumerate(inner))
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ParameterError, match="more than 100,000 values"):
        read_parameters(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[" * 100_000, "nested"),
        ("a: " * 3, "is not YAML"),
        ("{" * 40 + "}" * 40, "nested|is not YAML"),
        ("a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
            f"{chr(98 + k)}: &{chr(98 + k)} [{','.join([f'*{chr(97 + k)}'] * 10)}]\n"
            for k in range(8)
        ), "values"),
        ("x" * 1_000_001, "larger"),
        ("front_left: 3", "give a ROS parameter file"),
        ("\xff", "is not YAML"),
    ],
)  # fmt: skip
def test_an_invalid_parameter_file_is_refused_in_one_line(tmp_path, text, reason):
    path = tmp_path / "gains.yaml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ParameterError, match=reason) as error:
        read_parameters(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_files_are_written_together_and_overwritten_only_with_force(tmp_path):
    folder = tmp_path / "a" / "b"
    files: dict[Path, str | bytes] = {folder / "x.json": "1", folder / "y.yaml": b"2"}
    write_together(files)
    assert sorted(p.name for p in folder.iterdir()) == ["x.json", "y.yaml"]
    with pytest.raises(ParameterError, match="--force"):
        write_together({folder / "z": "3", folder / "y.yaml": "4"})
    assert sorted(p.name for p in folder.iterdir()) == ["x.json", "y.yaml"]
    assert (folder / "y.yaml").read_text() == "2"
    write_together({folder / "y.yaml": "4"}, force=True)
    assert (folder / "y.yaml").read_text() == "4"


def test_a_failed_write_restores_the_old_files(tmp_path, monkeypatch):
    write_together({tmp_path / "a": "old a", tmp_path / "c": "old c"})
    rename = os.replace

    def full(source: Path, target: Path) -> None:
        if Path(target).name == "c" and Path(source).read_text() == "new c":
            raise OSError(28, "No space left on device")
        rename(source, target)

    monkeypatch.setattr(os, "replace", full)
    new: dict[Path, str | bytes] = {tmp_path / n: f"new {n}" for n in ("a", "b", "c")}
    with pytest.raises(ParameterError, match="No space left"):
        write_together(new, force=True)
    kept = {p.name: p.read_text() for p in tmp_path.iterdir()}
    assert kept == {"a": "old a", "c": "old c"}


def test_output_folder_that_cannot_be_created_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ParameterError, match="cannot be written"):
        write_together({tmp_path / "file" / "sub" / "x": "1"})


def test_an_unidentifiable_parameter_is_null_and_listed():
    document = estimate(current=False).to_document()
    assert document["parameters"]["resistance"]["value"] is None
    assert document["unidentifiable"] == list(PHYSICAL)
    assert document["identifiable"] is False


def test_nan_is_written_as_null():
    unknown = Estimate("w", "m", {}, {"dc_gain": Quantity(1.0, float("nan"))})
    assert unknown.to_document()["combinations"]["dc_gain"]["std"] is None


def test_value_falls_back_to_the_given_default():
    assert estimate(current=False).value("resistance", 7.0) == 7.0
    assert estimate().value("dc_gain") == pytest.approx(25.5, rel=1e-15)  # stored, not computed
