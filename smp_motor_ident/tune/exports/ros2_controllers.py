# SPDX-License-Identifier: Apache-2.0
"""ros2_controllers: ``pid_controller`` with the gains of control_toolbox, Jazzy.

References
----------
control.ros.org/jazzy: ros2_controllers 4.42, pid_controller (src/pid_controller.yaml, src/
pid_controller.cpp: the feed-forward is added after the clamp); control_toolbox of Jazzy,
src/pid.cpp, ``compute_command``. The integral is forward Euler and used one step later, as in the
running loop of this package; back-calculation adds ``T / tracking_time_constant`` of the clamped
excess.
"""

import math
from collections.abc import Mapping

from smp_motor_control.parameter_file import format_parameters
from smp_motor_control.pid import Pid, PidGains
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.exports.target import Format, Gains, rounded
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.known_loop import KnownLoop, Setting, Step


def _convert(design: Design) -> Gains:
    ratio, supply = design.loop.gear_ratio, design.loop.supply_voltage
    p, i = (rounded(design.feedback.p * ratio), rounded(design.feedback.i * ratio))
    tracking = rounded(p / i)
    numbers = {
        "p": p, "i": i, "d": 0.0, "u_clamp_max": supply, "u_clamp_min": -supply,
        "tracking_time_constant": tracking, "feedforward_gain": 0.0,
    }  # fmt: skip
    feedback = Feedback(p / ratio, i / ratio)
    return Gains(numbers, feedback, tracking=tracking)


def _start(setting: Setting) -> Step:
    n, T = setting.numbers, setting.sample_time
    high, low = min(n["u_clamp_max"], setting.supply), max(n["u_clamp_min"], -setting.supply)
    of_pid = {name: value for name, value in n.items() if name != "feedforward_gain"}
    strategy = "back_calculation" if n["tracking_time_constant"] else "none"
    pid = Pid(PidGains(**of_pid, antiwindup_strategy=strategy, setpoint_weight_d=1.0))

    def step(setpoint: float, speed: float) -> float:
        command = pid.step(setpoint - speed, 0.0, T).output
        return min(max(command + n["feedforward_gain"] * setpoint, low), high)

    return step


def _render(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    joints = [f"{wheel}_wheel_joint" for wheel in designs]
    rate = math.floor(next(iter(designs.values())).loop.rate)
    parameters = {
        "dof_names": joints,
        "command_interface": "voltage",
        "reference_and_state_interfaces": ["velocity"],
        "enable_feedforward": False,
        "gains": {
            joint: {**one.numbers, "antiwindup_strategy": "back_calculation"}
            for joint, one in zip(joints, gains.values(), strict=True)
        },
    }
    manager = {"update_rate": rate, "pid_controller": {"type": "pid_controller/PidController"}}
    return format_parameters({"controller_manager": manager, "pid_controller": parameters})


FORMAT = Format(
    "ros2_controllers",
    "ros2_controllers pid_controller (volts of wheel rad/s)",
    "control.ros.org/jazzy, pid_controller and control_toolbox",
    100.0,
    _convert,
    _render,
    ("the planned reference, and without it feed-forward: an abrupt one would overshoot",),
    counts=False,
    known=KnownLoop(
        {
            "p": math.nan, "i": math.nan, "d": 0.0, "u_clamp_max": math.inf,
            "u_clamp_min": -math.inf, "tracking_time_constant": 0.0, "feedforward_gain": 0.0,
        },
        _start,
    ),
)  # fmt: skip
