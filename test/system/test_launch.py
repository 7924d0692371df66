"""The launch file, where a ROS with launch is sourced."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

LAUNCH = Path(__file__).parents[2] / "launch" / "smp.launch.py"


def test_launch_file_describes_plant_wheels_and_body():
    pytest.importorskip("launch_ros", reason="ros2 launch is not among the wheels")
    spec = importlib.util.spec_from_file_location("smp_launch", LAUNCH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    description = module.generate_launch_description()
    executables = [getattr(e, "node_executable", "") for e in description.entities]
    assert executables.count("wheel_pid") == 4
    assert {"motor_plant", "skid_steer"} <= set(executables)


def test_launch_file_is_python_that_names_real_executables_and_files():
    text = LAUNCH.read_text()
    compile(text, LAUNCH.name, "exec")
    root = LAUNCH.parents[1]
    for name in ("motors_paper.yaml", "gains.yaml", "skid_steer.yaml"):
        assert name in text and (root / "config" / name).exists()
