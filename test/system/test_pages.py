# SPDX-License-Identifier: Apache-2.0
"""The pages' ``sh`` blocks for a running robot, as they are printed, on the simulated one.

They take minutes, so they run on request: ``make test ARGS="-m long"``. Lines of ``ros2`` run
where ROS is sourced.
"""

import os
import re
import shutil
import signal
import subprocess
import threading
from pathlib import Path

import pytest
from test_documentation import ROOT, blocks_in, commands, motion, write_bag
from wheel_robot import CONFIG, WheelRobot, two_wheeled

from smp_motor_control import WHEELS
from smp_motor_ident.cli import identify

DRIVES = "# needs a robot that drives"
NEEDS = (DRIVES, "# needs a running robot", "# needs a terminal and a running robot",
         "# needs ROS 2")  # fmt: skip
SPEED = 1.2
"""Wheel speed of a driving robot [rad/s]."""
ENDLESS = ("record", "identifier", "teleop_wheels", "ros2")
"""Commands that run until Ctrl-C."""
ENDLESS_RUN_TIME = 12.0
"""Run time of such a command in the test [s]."""
LIMIT = 900.0
"""Time limit of other commands [s]; ``commission`` takes two minutes on two free cores."""
ELSEWHERE = ("plotjuggler", "foxglove_bridge", "nav2_bringup", "teleop_twist_joy")
"""External packages, which need a screen or a map."""


def find_robot_blocks() -> list[tuple[str, list[str]]]:
    blocks = [(page, lines) for page, lines in blocks_in("sh") if lines[0].strip() in NEEDS]
    here = shutil.which("ros2")
    return [b for b in blocks if here or not any(line.startswith("ros2 ") for line in b[1])]


def run(line: str, folder: Path) -> str:
    """Run a printed line in a terminal; return an error message or an empty string."""
    here, there = os.openpty()
    log = folder / "output.txt"
    with log.open("wb") as out:
        process = subprocess.Popen(
            ["bash", "-c", line], stdin=there, stdout=out, stderr=out, cwd=folder,
            start_new_session=True,
        )  # fmt: skip
        os.write(here, b"y\n")
        endless = line.split()[0] in ENDLESS and "--show-args" not in line
        try:
            process.wait(ENDLESS_RUN_TIME if endless else LIMIT)
        except subprocess.TimeoutExpired:
            if not endless:
                os.killpg(process.pid, signal.SIGKILL)
            else:
                os.killpg(process.pid, signal.SIGINT)
        code = process.wait(60.0)
        os.close(here), os.close(there)
    text = log.read_text(errors="replace")
    fine = code in ((0, 130, -signal.SIGINT) if endless else (0,)) and "Traceback" not in text
    return "" if fine else f"{line}: exit code {code}\n{text}"


TWO = ("left", "right")


@pytest.fixture
def robots(ros_domain, process, eventually, tmp_path):
    """Start a robot of two or four wheels in a namespace, driving or not; the last one ends."""
    watchers, threads, running, ended = [], [], [], threading.Event()
    four = CONFIG / "motors_paper.yaml", CONFIG / "gains.yaml"

    def start(namespace: str, wheels: tuple[str, ...], driving: bool, body: bool) -> None:
        while running:
            running.pop().end()
        place = ("--ros-args", "-r", f"__ns:={namespace or '/'}")
        motors, gains = two_wheeled(tmp_path) if wheels == TWO else four
        sides = (("left", wheels[::2]), ("right", wheels[1::2]))
        named = [f"{side}_wheel_names:=[{', '.join(names)}]" for side, names in sides]
        # A page's commands work at any rate; half of the usual one suits a small machine.
        rate = ("-p", "rate:=100.0")
        running.append(process("motor_plant", *place, "-p", f"motors_file:={motors}", *rate))
        if body:
            running.append(process("skid_steer", *place, "-p", named[0], "-p", named[1]))
        for wheel in wheels:
            there = ("--ros-args", "-r", f"__ns:={namespace}/{wheel}")
            running.append(process("wheel_pid", *there, "--params-file", gains))
        if not watchers:
            watchers.append(WheelRobot(ros_domain))
        heard = watchers[0].node.count_publishers
        topics = [f"{namespace}/{w}/{t}" for w in wheels for t in ("motor_state", "motor_command")]
        eventually(lambda: all(heard(topic) for topic in topics), 60.0, watchers[0].spin)
        if driving:
            watchers[0].setpoint = SPEED
            threads.append(threading.Thread(target=drive))
            threads[0].start()
            eventually(lambda: abs(watchers[0].velocity("front_left") - SPEED) < 0.1, 30.0)

    def drive() -> None:
        while not ended.is_set():
            watchers[0].spin()

    yield start
    ended.set()
    for one in threads:
        one.join()
    for one in watchers:
        one.close()


@pytest.mark.long
@pytest.mark.parametrize(("page", "lines"), find_robot_blocks())
def test_commands_for_a_running_robot_work_as_their_page_describes(page, lines, tmp_path, robots):
    write_bag(tmp_path / "my_bag", motion(1), own=True, current=True)
    answered = identify.main([str(tmp_path / "my_bag"), "--output", str(tmp_path / "result"), "-q"])
    assert answered == 0
    shutil.copy(ROOT / "config" / "gains.yaml", tmp_path)
    (tmp_path / "history.jsonl").touch()
    text = "\n".join(lines).replace("\\\n", " ")
    launched = "ros2 launch smp_motor_control smp.launch.py" in text
    place = re.compile(r"__ns:=(/\w+)")
    for namespace in ("", *sorted(set(place.findall(text)))):
        its = [one for one in text.splitlines() if "".join(place.findall(one)) == namespace]
        two = any("[left, right]" in one or "--wheel left" in one for one in its)
        if not launched:
            # Wheels on blocks need no body; two free cores are little for both.
            robots(namespace, TWO if two else WHEELS, driving=lines[0].strip() == DRIVES,
                   body="commission " not in text)  # fmt: skip
        for line in its:
            if commands([line]) and not any(name in line for name in ELSEWHERE):
                if line.startswith("record --output my_bag"):  # the page's own, not one made here
                    shutil.rmtree(tmp_path / "my_bag")
                assert not (wrong := run(line, tmp_path)), f"{page}: {wrong}"
