# SPDX-License-Identifier: Apache-2.0
"""The command ``tune``: files, exit codes, one-line errors."""

import contextlib
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from smp_motor_control import WHEELS
from smp_motor_control.pid import PidGains
from smp_motor_ident.cli import tuning
from smp_motor_ident.cli.tune import main, parser
from smp_motor_ident.cli.tuning import format_design
from smp_motor_ident.record import Hardware
from smp_motor_ident.report import tuning_page
from smp_motor_ident.report.document import identification_document, read_identification
from smp_motor_ident.result import Estimate, Quantity

MOTORS = Path(__file__).resolve().parents[2] / "config" / "motors_paper.yaml"


@pytest.fixture
def identified(tmp_path) -> Path:
    values = {"dc_gain": 25.5, "time_constant": 0.051, "time_constant_product": 8.1e-4}
    one = Estimate(
        wheel="",
        model="second_order",
        parameters={"inertia": Quantity(None, status="unidentifiable")},
        combinations={n: Quantity(v, 0.001 * v) for n, v in values.items()},
        names=tuple(values),
        covariance=np.diag([(0.001 * v) ** 2 for v in values.values()]),
        sample_time=0.005,
        sources=("drive_3.mcap",),
        hardware=Hardware(65.5, 500.0, 16, 12.0),
    )
    path = tmp_path / "identification.json"
    document = identification_document({wheel: replace(one, wheel=wheel) for wheel in WHEELS})
    path.write_text(json.dumps(document))
    return tmp_path


def test_the_parameter_file_is_accepted_by_the_four_nodes(identified, capsys):
    output = identified / "gains.yaml"
    assert main([str(identified), "--output", str(output)]) == 0
    tree = yaml.safe_load(output.read_text())
    assert list(tree) == [f"/**/{wheel}/wheel_pid" for wheel in WHEELS]
    for node in tree.values():
        parameters = node["ros__parameters"]
        names = set(PidGains.__dataclass_fields__)
        PidGains(**{n: v for n, v in parameters.items() if n in names})
        # An integer in YAML for a double parameter is an error in ROS.
        whole = [n for n, v in parameters.items() if type(v) is int]
        assert whole == ["difference_window"]
        assert all(type(v) is float for v in parameters["model"].values())
    head = output.read_text().split("/front_left")[0]
    for word in ("drive_3.mcap", "second_order", "phase margin", "UTC"):
        assert word in head
    document = json.loads((identified / "gains.json").read_text())
    assert document["wheels"]["rear_left"]["margins"]["phase"] > 59
    assert document["wheels"]["rear_left"]["loop"]["sample_time"] == 0.005
    assert (identified / "gains.svg").read_text().startswith(("<?xml", "<svg"))
    assert "one set of gains for all" in capsys.readouterr().out


def test_a_motor_file_of_identify_is_accepted(tmp_path, capsys):
    output = tmp_path / "gains.yaml"
    assert main([str(MOTORS), "--output", str(output), "--rate", "100", "--method", "simc"]) == 0
    assert "SIMC" in output.read_text()
    assert "no uncertainty" in capsys.readouterr().out


def test_comparison_lists_every_method_and_recommends_one(identified, capsys):
    assert main([str(identified), "--compare"]) == 0
    words_shown = capsys.readouterr().out
    for method in ("margin", "simc", "tyreus_luyben"):
        assert f" {method} " in words_shown
    assert "* recommended: " in words_shown


def test_every_step_is_announced_with_its_duration(identified, monkeypatch):
    told: list[str] = []

    @contextlib.contextmanager
    def progress(*_: object) -> Iterator[Callable[[str], None]]:
        yield told.append

    monkeypatch.setattr(tuning.frame, "progress", progress)
    assert main([str(identified), "--compare"]) == 0
    assert main([str(identified), "--export", "arduino_pid"]) == 0
    assert len(told) == 4 and all(" takes about " in text for text in told), told


def test_small_gains_are_shown_with_their_digits():
    design = SimpleNamespace(
        gains=PidGains(p=1.49e-4, i=1.5e-3),
        margins=SimpleNamespace(phase=88.0, gain=560.65, sensitivity=1.02),
        performance=SimpleNamespace(settling=2.07, overshoot=0.0, load_integral=6.62e-4,
                                    peak_voltage=4.04, control_noise=0.1),
    )  # fmt: skip
    assert format_design(design).split()[:3] == ["0.000149", "0.0015", "0"]
    assert "0.000662" in format_design(design)


@pytest.mark.parametrize("export", [[], ["--export", "arduino_pid"]])
def test_unwritable_output_is_refused_before_the_design(identified, capsys, monkeypatch, export):
    def design(*_: object, **__: object) -> None:
        raise AssertionError("designed before looking")

    monkeypatch.setattr(tuning, "design_wheels", design)
    monkeypatch.setattr(tuning, "export", design)
    monkeypatch.setattr(tuning, "choose_source", design)
    output = identified / "identification.json" / "gains.yaml"  # a file is no folder
    assert main([str(identified), "--output", str(output), *export]) == 2
    assert "identification.json: cannot be written" in capsys.readouterr().err


def test_terminal_page_and_gains_file_state_the_same_settling_time(identified, capsys, monkeypatch):
    monkeypatch.setattr(tuning_page, "BANDWIDTH_SHARES", (0.6, 1.0))
    monkeypatch.setattr(tuning_page, "PHASE_MARGINS", (60.0,))
    estimates = read_identification(identified)
    fast = replace(estimates["front_right"].combinations["dc_gain"], value=16.8)
    slower = {**estimates["front_right"].combinations, "dc_gain": fast}
    estimates["front_right"] = replace(estimates["front_right"], combinations=slower)
    document = identification_document({w: estimates[w] for w in ("front_left", "front_right")})
    (identified / "identification.json").write_text(json.dumps(document))
    assert main([str(identified), "--output", str(identified / "gains.yaml")]) == 0
    told = capsys.readouterr().out
    entries = json.loads((identified / "gains.json").read_text())["wheels"]

    estimates = read_identification(identified)
    usual = parser().parse_args([str(identified)])
    loops = {w: tuning.loop_for(one, usual) for w, one in estimates.items()}
    loops, _ = tuning.choose_sources(estimates, loops, {})
    designs, refused = tuning_page.design_all_wheels(estimates, loops)
    assert not refused
    tunings = {w: tuning_page.design_tuning(estimates[w], loops[w], designs[w]) for w in designs}
    for wheel, shown in tuning_page.page_data(tunings)["wheels"].items():
        stated = entries[wheel]["settling"]
        rows = {name: held for name, *held in shown["choices"][-1]["rows"]}
        settles = f"{1e3 * stated['value']:.3g} ms"
        assert rows["Settling within 2 % of a planned change"][0] == settles
        planned = f"Duration of a planned change by {stated['change']:.3g} rad/s"
        transition, _ = rows[f"{planned}, the same for all wheels"]
        assert transition == f"{1e3 * stated['transition']:.3g} ms"
        (line,) = [x for x in told.splitlines() if x.startswith(f"{wheel}: settles")]
        assert f"in {settles}" in line and f"transition of {transition} included" in line
        # One transition for all, also where the page asks for less bandwidth: as slow or slower.
        assert (
            stated["common"]
            and stated["transition"] == entries["front_left"]["settling"]["transition"]
        )
        softer = tunings[wheel].choices[0].design
        assert softer.settling.transition >= stated["transition"]


def test_nothing_is_overwritten_without_force(identified, capsys):
    output = identified / "gains.yaml"
    output.write_text("mine")
    assert main([str(identified), "--output", str(output)]) == 2
    assert output.read_text() == "mine"
    assert "--force" in capsys.readouterr().err
    assert main([str(identified), "--output", str(output), "--force"]) == 0
    assert output.read_text() != "mine"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--bandwidth", "900"], 1, "the nearest that holds is"),
        (["--max-acceleration", "1e6"], 1, "is beyond the motor"),
        (["--phase-margin", "nan"], 1, "phase_margin is nan"),
        (["--method", "guess"], 2, "--method is 'guess'"),
        (["--rate", "0"], 2, "--rate is 0"),
        (["--rate", "nan"], 2, "--rate is nan"),
        (["--delay", "-1"], 2, "delay is -1"),
        (["--supply", "-12"], 2, "supply_voltage is -12"),
        (["--gear-ratio", "0"], 2, "gear_ratio is 0"),
        (["--output", "gains.txt"], 2, "must end in .yaml"),
        (["--colour", "red"], 2, "unrecognized arguments"),
        (["--gains", "x.yaml"], 2, "--gains needs --apply"),
    ],
)
def test_refusal_is_one_line_with_its_exit_code(identified, capsys, arguments, code, words):
    assert main([str(identified), *arguments]) == code
    words_shown = capsys.readouterr().err.strip().splitlines()
    assert words in words_shown[-1]
    assert not any("Traceback" in line for line in words_shown)
    assert sorted(p.name for p in identified.iterdir()) == ["identification.json"]


def test_unreadable_identification_is_named(tmp_path, capsys):
    assert main([str(tmp_path / "identification.json")]) == 2
    assert "identification.json: cannot be read" in capsys.readouterr().err


def test_missing_input_is_refused(capsys):
    assert main([]) == 2
    assert "nothing to tune" in capsys.readouterr().err


def test_unknown_supply_voltage_is_refused_until_it_is_given(identified, capsys):
    path = identified / "identification.json"
    document = json.loads(path.read_text())
    document["motors"]["rear_left"]["hardware"]["supply_voltage"] = None
    path.write_text(json.dumps(document))
    assert main([str(identified)]) == 2
    assert "give --supply" in capsys.readouterr().err
    assert main([str(identified), "--supply", "12"]) == 0


def test_argument_choices_match_the_implemented_names():
    from smp_motor_ident.cli import tune as arguments
    from smp_motor_ident.tune import METHODS
    from smp_motor_ident.tune.exports import FORMATS
    from smp_motor_ident.tune.loop import SPEED_SOURCES

    assert tuple(METHODS) == arguments.METHODS
    assert tuple(FORMATS) == arguments.FORMATS
    assert arguments.SPEED_SOURCES == SPEED_SOURCES
