# SPDX-License-Identifier: Apache-2.0
"""Every printed command is run, or is marked with its requirements and uses existing options.

A fence is ``bash`` if its commands run here, page by page in order, and ``sh`` if they need
something else: its first line names it.  ``output`` is printed by the fence before it, and the
``python`` of a tutorial runs in order.
"""

import json
import math
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import rclpy
import recordings
import yaml
from printed import agree, not_printed
from recordings import COUNTS, RATIO, START, Motion, floats, in_order, joint_state

from smp_motor_control import WHEELS
from smp_motor_control.entry import split_arguments
from smp_motor_control.motor import Motor
from smp_motor_control.motor.file import load_motors
from smp_motor_control.serial_protocol import decode_state, encode_age, encode_voltages
from smp_motor_ident.cli import commission, demo, identify, lab, tune
from smp_motor_ident.nodes import play, record

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    "README.md",
    *sorted(str(p.relative_to(ROOT)) for p in ROOT.glob("docs/**/*.md") if "_build" not in p.parts),
]
TOOLS = {"identify": identify.main, "tune": tune.main}
PARSERS = {
    "identify": identify.parser,
    "tune": tune.parser,
    "commission": commission.parser,
    "demo": demo.parser,
    "lab": lab.parser,
    "record": record.parser,
    "play": play.parser,
}
NODES = ("wheel_pid", "motor_plant", "skid_steer", "teleop_wheels", "excite", "serial_driver",
         "record", "play", "identifier")  # fmt: skip
LANGUAGES = {"bash", "sh", "python", "output", "yaml", "xml", "json", "cpp", "text", "",
             "{toctree}", "{include}", "{eval-rst}"}  # fmt: skip


def blocks(page: str) -> Iterator[tuple[str, list[str]]]:
    """Return language and lines of each fence of a page."""
    inside = None
    for line in (ROOT / page).read_text(encoding="utf-8").splitlines():
        if inside is None and (fence := re.match(r"\s*```([\w{}-]*)[\w ./-]*$", line)):
            inside = (fence[1], [])
        elif inside is not None and line.strip() == "```":
            yield inside
            inside = None
        elif inside is not None:
            inside[1].append(line)
    assert inside is None, f"{page}: a fence is not closed"


def commands(lines: list[str]) -> list[list[str]]:
    """Return the commands of a block as words."""
    text = "\n".join(lines).replace("\\\n", " ")
    return [words for line in text.splitlines() if (words := shlex.split(line, comments=True))]


def blocks_in(language: str) -> list[tuple[str, list[str]]]:
    return [(page, lines) for page in PAGES for name, lines in blocks(page) if name == language]


def program(page: str, language: str) -> str:
    """Return the one block of a page in a language."""
    (lines,) = [lines for name, lines in blocks(page) if name == language]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("page", PAGES)
def test_code_blocks_declare_whether_their_commands_run_here(page):
    for language, lines in blocks(page):
        assert language in LANGUAGES, f"{page}: ```{language}"
        if language == "sh":
            assert lines[0].strip().startswith("# needs "), f"{page}: {lines[0]}: say what it needs"
        if language in ("", "text"):
            for line in lines:
                command = re.match(
                    rf"\s*({'|'.join([*PARSERS, *NODES])}|make|ros2|colcon) [\w-]", line
                )
                assert not command, f"{page}: a command in a block without language: {line}"


@pytest.mark.parametrize(("page", "lines"), blocks_in("sh"))
def test_commands_not_run_here_use_existing_options(page, lines):
    for words in commands(lines):
        name, arguments = words[0], words[1:]
        if name == "ros2" and words[1:3] == ["run", "smp_motor_control"]:
            name, arguments = words[3], words[4:]
            assert name in {*PARSERS, *NODES}, f"{page}: {words}"
        if "--help" in arguments:
            continue
        if name in PARSERS:
            own, _ = split_arguments(arguments)
            assert PARSERS[name]().parse_args(own), f"{page}: {words}"
        elif name in NODES and "--ros-args" in arguments:
            parameters = declared_parameters(name)
            for given in re.findall(r"(?<=-p )([\w.]+):=", " ".join(arguments)):
                assert given in parameters, f"{page}: {name} has no parameter {given}"
        elif name == "make":
            targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            assert set(arguments) <= set(targets), f"{page}: {words}"
        elif words[:4] == ["ros2", "launch", "smp_motor_control", "smp.launch.py"]:
            declared = re.findall(
                r'^    "(\w+)": \(', (ROOT / "launch/smp.launch.py").read_text(), re.M
            )
            given = [word.partition(":=")[0] for word in words[4:] if ":=" in word]
            assert set(given) <= set(declared), f"{page}: {words}"


def declared_parameters(node: str) -> set[str]:
    """Return the parameters that a node declares."""
    import importlib

    from smp_motor_control.fields import parameters_in

    package = "smp_motor_ident" if node == "identifier" else "smp_motor_control"
    module = importlib.import_module(f"{package}.nodes.{node}")
    return {*parameters_in(module.Settings), "use_sim_time"}


# The recordings that the pages refer to.

STEP = 0.01
PARTS, WINDOW = 5, 16
"""Steps of 2 ms; one log's speed is averaged over 32 ms."""
SENSOR = 0.005
"""Standard deviation of a measured current [A]."""


def motion(seed: int, seconds: float = 12.0) -> SimpleNamespace:
    """Simulate a motor of the paper under random steps, with its encoder read at 100 Hz."""
    motor = Motor(load_motors(ROOT / "config/motors_paper.yaml")["front_left"].parameters)
    n = round(seconds / STEP)
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(-9.0, 9.0, n // 12 + 1), 12)[:n]
    fine, amps = np.zeros(WINDOW + PARTS * n), np.zeros(PARTS * n)
    for k in range(PARTS * n):
        fine[WINDOW + k], amps[k] = motor.angle, motor.current
        motor.step(voltage[k // PARTS], STEP / PARTS)
    angle = fine[WINDOW::PARTS]
    averaged = (angle - fine[: PARTS * n : PARTS]) / (WINDOW * STEP / PARTS)
    count = np.floor(angle * COUNTS / (2 * math.pi)).astype(int)
    speed = np.diff(count, prepend=0) * 2 * math.pi / COUNTS / STEP  # [rad/s], motor
    current = amps[::PARTS] + rng.normal(0.0, SENSOR, n)
    return SimpleNamespace(
        t=STEP * np.arange(n), u=voltage, i=current, count=count, w=speed, averaged=averaged
    )


def write_bag(path: Path, one: SimpleNamespace, own: bool, current: bool = False) -> None:
    """Write our messages, or PWM and joint states as on other robots."""
    stamps = START + np.rint(1e9 * one.t).astype(np.int64)
    if own:
        mean = np.concatenate(([0.0], one.u[:-1]))  # over the interval that ends with the sample
        amps = one.i if current else np.full(one.t.size, math.nan)
        position = one.count * 2 * math.pi / COUNTS / RATIO
        state = Motion("front_left", stamps, mean, amps, one.w / RATIO, position, one.count)
        recordings.write_bag(path, state.messages(latency=0))
    else:
        speeds = [joint_state(t, ["left_wheel_joint"], [w]) for t, w in zip(stamps, one.w)]
        duties = floats("/pwm", stamps, one.u * 255 / 12)
        recordings.write_bag(path, in_order(speeds, duties))


def simulate_pid_v1(seconds: float) -> np.ndarray:
    """Simulate the motor under PID_v1 (Kp 15, Ki 150, 10 ms, 255 is 12 V).

    Return columns of time, set-point and speed.
    """
    motor = Motor(load_motors(ROOT / "config/motors_paper.yaml")["front_left"].parameters)
    n = round(seconds / STEP)
    targets = np.repeat(np.random.default_rng(7).uniform(-2.5, 2.5, n // 30 + 1), 30)[:n]
    targets[:30] = 0.0
    rows, total, before = [], 0.0, 0
    for k, target in enumerate(targets):
        count = math.floor(motor.angle * COUNTS / (2 * math.pi))
        speed, before = (count - before) * 2 * math.pi / COUNTS / STEP / RATIO, count
        total = min(max(total + 150 * STEP * (target - speed), -255), 255)
        pwm = int(min(max(15 * (target - speed) + total, -255), 255))
        rows.append((k * STEP, target, speed))
        motor.step(pwm / 255 * 12.0, STEP)
    return np.array(rows)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the recordings, and with the result that one page uses."""
    folder = tmp_path_factory.mktemp("documentation")
    for seed, name in enumerate(("my_bag", "monday", "tuesday", "wednesday"), 1):
        write_bag(folder / name, motion(seed), own=True)
    one = motion(5)
    write_bag(folder / "robot_bag", one, own=False)
    degrees = np.degrees(one.w)
    for name in ("log.csv", "prbs_2026-08-14.csv"):
        np.savetxt(folder / name, np.column_stack((one.t, one.u, degrees)), delimiter=",",
                   header="t,u,y", comments="", fmt="%.9g")  # fmt: skip
    columns = (1e3 * one.t, one.u * 5319 / 12 + 1, one.averaged * 30 / math.pi + 1.24)
    np.savetxt(folder / "log_20260601161631.csv", np.column_stack(columns), delimiter=",",
               header="Timestamp(ms),Commanded_PWM,Motor_Speed(RPM)", comments="",
               fmt="%.9g")  # fmt: skip
    loop = simulate_pid_v1(seconds=12.0)
    np.savetxt(folder / "loop.csv", loop, delimiter=",", header="t,target,speed", comments="",
               fmt="%.9g")  # fmt: skip
    assert identify.main([str(folder / "my_bag"), "--output", str(folder / "result"), "-q"]) == 0
    return folder


@pytest.mark.parametrize("page", dict.fromkeys(page for page, _ in blocks_in("bash")))
def test_commands_run_in_the_order_of_their_page(page, inputs, tmp_path, monkeypatch, capsys):
    made = {words[3] for name, lines in blocks(page) if name == "bash"
            for words in commands(lines) if words[2:3] == ["--output"]}  # fmt: skip
    for entry in inputs.iterdir():
        if entry.name not in made:
            (tmp_path / entry.name).symlink_to(entry)
    monkeypatch.chdir(tmp_path)
    printed: list[str] = []
    for name, lines in blocks(page):
        if name == "python" and page.startswith("docs/tutorial/"):
            exec(compile("\n".join(lines), page, "exec"), {})
        elif name == "output":
            assert not_printed(lines, printed) == [], "\n".join(printed)
        elif name == "bash":
            capsys.readouterr()
            for words in commands(lines):
                assert words[0] in TOOLS, f"{page}: {words[0]} does not run here; mark the block sh"
                code = TOOLS[words[0]](words[1:])
                out, err = capsys.readouterr()
                assert code == 0, f"{page}: {shlex.join(words)}: {err}"
                printed = out.splitlines()


def test_driver_example_publishes_counts_and_applies_commands():
    names: dict[str, object] = {}
    exec(compile(program("docs/howto/your-hardware.md", "python"), "your-hardware", "exec"), names)
    counts, applied = iter((2**15 - 1, -(2**15))), []
    board = SimpleNamespace(read_count=lambda: next(counts), apply=applied.append)
    rclpy.init()
    try:
        node = names["Driver"](board)
        published = []
        node.states = SimpleNamespace(publish=published.append)
        node.on_timer()
        node.on_command(names["MotorCommand"](voltage=3.0))
        node.on_timer()
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
    assert applied == [0.0, 3.0]
    # One count of a 16-bit counter that wraps between two samples, 10 ms apart, behind 1:30.
    assert published[1].velocity == pytest.approx(2 * math.pi / 48 / 30 / 0.01)
    assert [one.voltage for one in published] == [0.0, 3.0]


BOARD = """
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <algorithm>
enum { LOW, HIGH, INPUT_PULLUP, OUTPUT, CHANGE, A0 = 14 };
static unsigned long clock_us = 0;
static char fed[256];
static int at = 0, size = 0;
struct { void begin(long) {} int available() { return size - at; } char read() { return fed[at++]; }
         void print(const char *text) { fputs(text, stdout); } } Serial;
unsigned long micros() { return clock_us; }
int digitalRead(int) { return 0; }
int analogRead(int) { return 818; }
void digitalWrite(int, int) {}
void analogWrite(int pin, int value) { printf("pwm %d %d\\n", pin, value); }
void pinMode(int, int) {}
void interrupts() {}
void noInterrupts() {}
int digitalPinToInterrupt(int pin) { return pin; }
void attachInterrupt(int, void (*)(), int) {}
long constrain(long x, long low, long high) { return std::min(std::max(x, low), high); }
#include "sketch.ino"
int main() {
  setup();
  while (fgets(fed, sizeof fed, stdin)) {
    at = 0; size = strlen(fed);
    if (fed[0] == '+') { size = 0; clock_us += atol(fed); } else clock_us += 10000;
    loop();
  }
}
"""


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """Return the page's firmware on a computer: lines to the board give its answers."""
    folder = tmp_path_factory.mktemp("firmware")
    (folder / "sketch.ino").write_text(program("docs/howto/micro-controller.md", "cpp"))
    (folder / "board.cpp").write_text(BOARD)
    build = ["c++", "-Wall", "-Werror", "-o", "board", "board.cpp"]
    subprocess.run(build, cwd=folder, check=True, timeout=120)

    def run(said: str) -> list[str]:
        return subprocess.run([folder / "board"], input=said, capture_output=True, text=True,
                              check=True, timeout=60).stdout.splitlines()  # fmt: skip

    return run


def test_firmware_example_follows_protocol_and_stops_on_silence(board):
    good = encode_voltages([3.0, -6.0]).decode()
    said = f"{good}{good.replace('3000', '9000')}+150000\n+150000\n"
    lines = board(said)
    states = [decode_state(line, 2) for line in lines if line.startswith("S")]
    # 818 of 1023 at 15 V full scale.
    assert states[0].battery == pytest.approx(818 * 15 / 1023, abs=1e-3)
    assert len(states) == 4
    duty = [int(line.split()[2]) for line in lines if line.startswith("pwm 5")]
    # The corrupted line of 9 V changes nothing; after 0.3 s of silence the motor is off.
    assert duty == [63, 63, 63, 0]


def test_firmware_example_drops_outdated_queued_commands(board):
    # Each line takes 10 ms of the board's clock; the command of 3 V answers its sample at 10 ms.
    command = encode_age(10_000).decode() + encode_voltages([3.0, 3.0]).decode()
    fresh = encode_age(1_440_000).decode() + encode_voltages([6.0, 6.0]).decode()
    said = command + "+1400000\n" + command + fresh
    duty = [int(line.split()[2]) for line in board(said) if line.startswith("pwm 5")]
    assert duty == [0, 63, 0, 0, 0, 0, 127]


def test_plot_layouts_use_published_topics_and_fields():
    text = (ROOT / "smp_interfaces/msg/PidState.msg").read_text()
    fields = {line.split()[1] for line in text.splitlines() if line and line[0] not in "#"}
    topics = {f"/{wheel}/pid_state" for wheel in WHEELS}
    tree = ElementTree.parse(ROOT / "config/plotjuggler_wheels.xml")
    drawn = [tuple(c.attrib["name"].rsplit("/", 1)) for c in tree.iter("curve")]
    layout = json.loads((ROOT / "config/foxglove_wheels.json").read_text())
    drawn += [tuple(path["value"].split(".")) for plot in layout["configById"].values()
              for path in plot["paths"]]  # fmt: skip
    assert {topic for topic, _ in drawn} == topics
    assert {field for _, field in drawn} <= fields


def test_nodes_page_matches_the_nodes():
    made = subprocess.run(
        [sys.executable, ROOT / "scripts/nodes.py"], check=True, capture_output=True, text=True
    )
    page = (ROOT / "docs/nodes.md").read_text()
    assert page == made.stdout, "python scripts/nodes.py > docs/nodes.md"


@pytest.mark.slow
def test_paper_page_matches_its_command(tmp_path):
    command = [sys.executable, ROOT / "benchmarks/paper.py", "--output", tmp_path]
    subprocess.run(command, check=True, capture_output=True)
    shown, fresh = (
        (folder / "paper.md").read_text().splitlines() for folder in (ROOT / "docs", tmp_path)
    )
    stale = [a for a, b in zip(shown, fresh, strict=True) if not agree(a, b)]
    assert stale == [], "make paper"


def test_names_in_ros2_controllers_table_are_existing_parameters():
    text = (ROOT / "docs/ros2-controllers.md").read_text()
    topics = set(re.findall(r"`([\w/<>~]+)`", (ROOT / "docs/nodes.md").read_text())) | {"/tf"}
    names = declared_parameters("skid_steer"), declared_parameters("wheel_pid"), topics
    for there, part in zip(names, text.split("\n## ")[1:], strict=True):
        rows = [line.split("|") for line in part.splitlines() if line.startswith("| ")][1:]
        ours = {name for row in rows for name in re.findall(r"`([\w./<>~]+)`", row[2])}
        assert ours <= there
        assert all(row[2].strip() or row[3].strip() for row in rows)  # nothing without a reason


def test_yaml_and_xml_blocks_are_valid():
    for _, lines in blocks_in("yaml"):
        assert yaml.safe_load("\n".join(lines))
    for _, lines in blocks_in("xml"):
        ElementTree.fromstring("\n".join(lines))
