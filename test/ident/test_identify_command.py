# SPDX-License-Identifier: Apache-2.0
"""The command ``identify``: files, exit codes, one-line errors."""

import json
import os
import re
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest
from recordings import write_steps

from smp_motor_control.motor.file import load_motors
from smp_motor_ident.cli import frame, identification, tune
from smp_motor_ident.cli.identification import OUTPUTS
from smp_motor_ident.cli.identify import main
from smp_motor_ident.finding import Finding
from smp_motor_ident.report import words
from smp_motor_ident.result import ChainRecord, Estimate, Quantity

GAIN, LAG = 25.0, 0.06
MAP = ("--map", "time=t", "voltage=u", "velocity=w")
REAL = Path(__file__).parents[3] / "shared" / "data" / "prbs_gearmotor"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_steps(tmp_path_factory.mktemp("data") / "log.csv")


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the only line on standard error."""
    lines = capsys.readouterr().err.strip().splitlines()
    lines = [line for line in lines if not line.endswith(" ...")]  # progress of slow steps
    assert len(lines) == 1, lines
    assert lines[0].startswith("identify: ")
    assert "Traceback" not in lines[0]
    return lines[0]


def test_progress_is_repeated_during_many_short_steps(capsys, monkeypatch):
    monkeypatch.setattr(frame, "SILENCE_S", 1.0)
    said, end = "", time.monotonic() + 20.0
    with frame.progress("identify", takes="10 s") as say:
        while said.count("\n") < 2 and time.monotonic() < end:
            say("fitting friction")
            threading.Event().wait(0.01)
            said += capsys.readouterr().err
    first = "identify: fitting friction (usually 10 s) ..."
    assert said.splitlines()[:2] == [first, "identify: fitting friction ..."]


def test_identify_writes_its_three_files_and_recovers_the_motor(recording, tmp_path):
    output = tmp_path / "result"
    assert main([str(recording), *MAP, "--output", str(output)]) == 0
    assert sorted(p.name for p in output.iterdir()) == sorted(OUTPUTS)
    (motor,) = json.loads((output / "identification.json").read_text())["motors"].values()
    for name, truth in (("dc_gain", GAIN), ("time_constant", LAG)):
        found = motor["combinations"][name]
        # Four standard deviations: 1 in 16,000 by chance, and the seed is fixed.
        assert abs(found["value"] - truth) < 4 * found["std"]
        assert found["std"] < 0.02 * truth  # 2000 samples at 0.3 % noise determine it far better
    assert motor["sources"] == ["log"] or motor["sources"] == ["log.csv"]
    (entry,) = load_motors(output / "motors.yaml").values()
    assert entry.parameters.dc_gain == pytest.approx(motor["combinations"]["dc_gain"]["value"])
    page = (output / "report.html").read_text()
    assert "<svg" in page
    assert "log.csv" in page


UNITS = {"ms": 1e-3, "ms²": 1e-6}


def test_terminal_json_and_page_state_the_same_numbers(recording, tmp_path, capsys, browser):
    output = tmp_path / "result"
    assert main([str(recording), *MAP, "--output", str(output)]) == 0
    terminal = capsys.readouterr().out
    (motor,) = json.loads((output / "identification.json").read_text())["motors"].values()
    browser.open(output / "report.html", 1280)
    rows: list[list[str]] = browser.value(
        "[...document.querySelectorAll('.values tbody tr')].map(r => [r.children[0].firstChild"
        ".textContent.trim(), r.children[1].textContent])"
    )
    fit = browser.value("document.querySelector('.fit').textContent")
    assert fit in " ".join(terminal.split())
    assert f"{motor['fit_percent']['validation']:.1f} %" in fit
    page = dict(rows)
    for name in ("dc_gain", "time_constant"):
        text = page[words.label(name)]
        # Label and number are on one line of the terminal, separated by spaces only.
        assert re.search(rf"{words.label(name)} +{re.escape(text)} ", terminal)
        value, std, unit = re.fullmatch(r"([\d.]+) ± ([\d.]+) (\S+)", text).groups()
        digit = 10.0 ** -len(value.partition(".")[2])  # of the last decimal
        for written, kept in ((value, "value"), (std, "std")):
            stated = motor["combinations"][name][kept] / UNITS.get(unit, 1.0)
            assert float(written) == pytest.approx(stated, abs=0.501 * digit)


def test_terminal_shows_the_three_most_severe_findings(recording, tmp_path, monkeypatch, capsys):
    findings = [
        *(Finding(f"note_{k}", "note", f"note {k} of dc_gain") for k in range(2)),
        *(Finding(f"odd_{k}", "warning", f"warning {k}", {}, f"do {k}") for k in range(3)),
        Finding("lag_unknown", "unreliable", "the data do not tell dc_gain", {}, "record more"),
    ]
    shown = replace(found("note"), findings=tuple(findings))
    monkeypatch.setattr(identification, "estimate", lambda *_, **__: shown)
    arguments = [str(recording), *MAP, "--output", str(tmp_path / "r"), "--force"]
    assert main(arguments) == 1
    said = capsys.readouterr()
    assert re.findall(r"^\d\. .*$", said.out, re.MULTILINE) == [
        "1. Unreliable: The data do not tell DC gain. Record more.",
        "2. Warning: Warning 0. Do 0.",
        "3. Warning: Warning 1. Do 1.",
    ]
    assert "Unreliable: every number." in said.out  # the only finding
    assert re.search(r"DC gain +25.00 ± 0.10 rad/s/V .*unreliable, see 1", said.out)
    assert "3 more findings: in the report, or with --verbose." in said.out
    assert said.err.startswith("identify: motor: Unreliable: every number (lag_unknown). Record")
    assert main([*arguments, "--verbose"]) == 1
    said = capsys.readouterr()
    assert len(re.findall(r"^\d\. ", said.out, re.MULTILINE)) == len(findings)
    assert "6. Note: Note 1 of DC gain." in said.out


def test_existing_files_are_overwritten_only_with_force(recording, tmp_path, capsys):
    (tmp_path / "motors.yaml").write_text("mine")
    arguments = [str(recording), *MAP, "--output", str(tmp_path), "--quiet"]
    assert main(arguments) == 2
    assert "motors.yaml" in complaint(capsys)
    assert [p.name for p in tmp_path.iterdir()] == ["motors.yaml"]
    assert (tmp_path / "motors.yaml").read_text() == "mine"
    assert main([*arguments, "--force"]) == 0
    assert (tmp_path / "motors.yaml").read_text() != "mine"


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["nowhere.mcap"], "nowhere.mcap"),
        (["log.csv"], "log.csv"),  # a CSV file without a mapping
        (["log.csv", "--map", "time=t", "voltage=u", "velocity=speed"], "speed"),
        (["log.csv", *MAP, "--fix", "weight=3"], "weight"),
        (["log.csv", *MAP, "--fix", "resistance=-3"], "-3"),
        (["log.csv", *MAP, "--fix", "resistance=many"], "many"),
        (["log.csv", *MAP, "--model", "quantum"], "quantum"),
        (["log.csv", *MAP, "--wheel", "fifth"], "fifth"),
        (["log.csv", *MAP, "--mapping", "m.yaml"], "--mapping"),
        (["log.csv", "--mapping", "m.yaml"], "m.yaml"),
        (["log.csv", *MAP, "--validate", "absent.csv"], "absent.csv"),
        (["log.csv", *MAP, "--nonsense"], "--nonsense"),
        ([], "BAG"),
    ],
)
def test_wrong_usage_is_refused(arguments, word, recording, tmp_path, monkeypatch, capsys):
    (tmp_path / "log.csv").write_bytes(recording.read_bytes())
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, "--output", "result"]) == 2
    assert word in complaint(capsys)
    assert not (tmp_path / "result").exists()


def test_missing_output_option_is_refused(recording, capsys):
    assert main([str(recording), *MAP]) == 2
    assert "--output" in complaint(capsys)


def test_recording_of_a_motor_at_rest_is_refused_with_advice(tmp_path, capsys):
    still = write_steps(tmp_path / "still.csv", level=0.0)
    assert main([str(still), *MAP, "--output", str(tmp_path / "result")]) == 1
    assert "record" in complaint(capsys)
    assert not (tmp_path / "result").exists()


def test_good_wheels_are_written_when_another_is_refused(tmp_path, capsys):
    good, still = write_steps(tmp_path / "a.csv"), write_steps(tmp_path / "b.csv", level=0.0)
    both = np.hstack([np.loadtxt(p, delimiter=",", skiprows=1) for p in (good, still)])
    np.savetxt(
        tmp_path / "both.csv", both, delimiter=",", header="t,u,w,t2,u2,w2", comments="", fmt="%g"
    )
    names = ["left.time=t", "left.voltage=u", "left.velocity=w"]
    names += ["right.time=t", "right.voltage=u2", "right.velocity=w2"]
    output = tmp_path / "result"
    arguments = [str(tmp_path / "both.csv"), "--map", *names, "--output", str(output), "--quiet"]
    assert main(arguments) == 1
    assert "right" in complaint(capsys)
    assert list(json.loads((output / "identification.json").read_text())["motors"]) == ["left"]
    assert "not identified" in (output / "report.html").read_text()


def test_model_is_validated_on_a_separate_recording(recording, tmp_path):
    other = write_steps(tmp_path / "other.csv", seed=2)
    output = tmp_path / "result"
    arguments = [str(recording), *MAP, "--validate", str(other), "--output", str(output)]
    assert main(arguments) == 0
    (motor,) = json.loads((output / "identification.json").read_text())["motors"].values()
    # Noise of 0.5 on a speed that scatters by 85: a perfect model reaches 99.4 %.
    assert motor["fit_percent"]["validation"] > 99.0
    assert "other.csv" in (output / "report.html").read_text()


def test_executable_reports_an_unreadable_bag_without_traceback(process, tmp_path):
    (tmp_path / "not_a_bag.mcap").write_bytes(b"not a bag at all")
    tool = process("identify", "not_a_bag.mcap", "--output", "result")
    assert tool.wait(60.0) == 2
    lines = tool.output.strip().splitlines()
    assert len(lines) == 1
    assert "not_a_bag.mcap" in lines[0]
    assert not (tmp_path / "result").exists()


def found(severity: str) -> Estimate:
    """Return an estimate whose data show a dead zone."""
    finding = Finding("dead_zone", severity, "a dead zone of 1 V", {}, "record a slow ramp")
    known = {"dc_gain": Quantity(25.0, 0.1, (24.8, 25.2), "rad/s/V")}
    chain = ChainRecord(("first_order", "speed"), {"ln_a0": -3.2, "ln_a1": -6.0})
    return Estimate("motor", "first_order", {}, known, findings=(finding,), chain=chain)


@pytest.mark.parametrize(
    ("severity", "options", "code"),
    [
        ("note", (), 0),
        ("warning", (), 0),
        ("unreliable", (), 1),
        ("unreliable", ("--accept-unreliable",), 0),
    ],
)
def test_unreliable_result_is_written_with_exit_code_1_unless_accepted(
    severity, options, code, recording, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(identification, "estimate", lambda *_, **__: found(severity))
    output = tmp_path / "result"
    assert main([str(recording), *MAP, "--output", str(output), "--quiet", *options]) == code
    said = capsys.readouterr().err
    assert ("Record a slow ramp." in said) == (code == 1)
    assert "a dead zone of 1 V" not in said  # stated in the report and in the table above
    (motor,) = json.loads((output / "identification.json").read_text())["motors"].values()
    assert motor["findings"][0]["severity"] == severity
    page = (output / "report.html").read_text()
    assert "A dead zone of 1 V." in page
    assert "Record a slow ramp." in page


def test_closed_standard_output_does_not_change_the_exit_code(recording, tmp_path):
    command = [sys.executable, "-m", "smp_motor_ident.cli.identify", str(recording), *MAP]
    tool = subprocess.Popen(
        [*command, "--output", str(tmp_path / "result")], stdout=subprocess.PIPE, stderr=PIPE
    )
    tool.stdout.close()
    assert tool.wait(120.0) == 0
    assert b"Error" not in tool.stderr.read()
    assert (tmp_path / "result" / "report.html").is_file()


@pytest.mark.parametrize("tool", ["identify", "commission", "demo"])
def test_help_imports_no_numerical_modules(tool):
    # Imports are checked, since a duration would depend on the load of the machine.
    program = (
        f"import sys\nfrom smp_motor_ident.cli.{tool} import main\nassert main(['--help']) == 0\n"
        "slow = {'numpy', 'scipy', 'numba', 'rosbags', 'matplotlib', 'yaml', 'rich', 'jinja2'}\n"
        "assert not slow & set(sys.modules), slow & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("node", ["record", "play"])
def test_record_and_play_nodes_import_no_numerical_modules(node):
    slow = "assert not {'scipy', 'numba', 'matplotlib'} & set(sys.modules)"
    program = f"import sys\nimport smp_motor_ident.nodes.{node}\n{slow}\n"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_paths_that_are_not_utf_8_are_read_and_written(recording, tmp_path):
    name = os.fsdecode(b"log\xff\xfe")
    log, output = tmp_path / f"{name}.csv", tmp_path / name
    log.write_bytes(recording.read_bytes())
    given = [*MAP, "--output", str(output), "--force"]
    assert main([str(log), *given]) == 0
    document = json.loads((output / OUTPUTS[0]).read_text())
    assert document["motors"]["motor"]["sources"] == ["log\ufffd\ufffd.csv"]
    text = (output / OUTPUTS[2]).read_text()
    assert "log\ufffd\ufffd.csv" in text or "log??.csv" in text
    assert tune.main([str(output), "--supply", "12", "--output", f"{output}.yaml"]) == 0


def test_unwritable_output_is_refused_before_computing(recording, tmp_path, capsys):
    nowhere = "/proc/self/nothing"  # where not even root may write
    assert main([str(tmp_path / "no.csv"), *MAP, "--output", nowhere]) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert tune.main([str(tmp_path), "--output", f"{nowhere}.yaml"]) == 2
    assert "cannot be written" in capsys.readouterr().err
