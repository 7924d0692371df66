# SPDX-License-Identifier: Apache-2.0
"""Define the targets of exports: units, arithmetic, and sources of both."""

import math
from collections.abc import Mapping

from smp_motor_control.parameter_file import format_parameters
from smp_motor_control.pid import Pid, PidGains
from smp_motor_ident.errors import DesignError, SignalError
from smp_motor_ident.tune.designer import Design
from smp_motor_ident.tune.exports.target import (
    Format,
    Gains,
    absorb_present_error,
    rounded,
    ticks,
    top_speed,
    whole_milliseconds,
)
from smp_motor_ident.tune.feedback import Feedback
from smp_motor_ident.tune.known_loop import KnownLoop, Setting, Step

MAX_PWM = 255  # of eight bits, as Arduino's `analogWrite` takes it


# ros2_controllers: ``pid_controller`` with the gains of control_toolbox, Jazzy.
# control.ros.org/jazzy: ros2_controllers 4.42, pid_controller (src/pid_controller.yaml, src/
# pid_controller.cpp: the feed-forward is added after the clamp); control_toolbox of Jazzy,
# src/pid.cpp, ``compute_command``. The integral is forward Euler and used one step later, as in
# the running loop of this package; back-calculation adds ``T / tracking_time_constant`` of the
# clamped excess.


def _convert_ros2_controllers(design: Design) -> Gains:
    ratio, supply = design.loop.gear_ratio, design.loop.supply_voltage
    p, i = (rounded(design.feedback.p * ratio), rounded(design.feedback.i * ratio))
    tracking = rounded(p / i)
    numbers = {
        "p": p, "i": i, "d": 0.0, "u_clamp_max": supply, "u_clamp_min": -supply,
        "tracking_time_constant": tracking, "feedforward_gain": 0.0,
    }  # fmt: skip
    feedback = Feedback(p / ratio, i / ratio)
    return Gains(numbers, feedback, tracking=tracking)


def _start_ros2_controllers(setting: Setting) -> Step:
    n, T = setting.numbers, setting.sample_time
    high, low = min(n["u_clamp_max"], setting.supply), max(n["u_clamp_min"], -setting.supply)
    of_pid = {name: value for name, value in n.items() if name != "feedforward_gain"}
    strategy = "back_calculation" if n["tracking_time_constant"] else "none"
    pid = Pid(PidGains(**of_pid, antiwindup_strategy=strategy, setpoint_weight_d=1.0))

    def step(setpoint: float, speed: float) -> float:
        command = pid.step(setpoint - speed, 0.0, T).output
        return min(max(command + n["feedforward_gain"] * setpoint, low), high)

    return step


def _render_ros2_controllers(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
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


ROS2_CONTROLLERS = Format(
    "ros2_controllers",
    "ros2_controllers pid_controller (volts of wheel rad/s)",
    "control.ros.org/jazzy, pid_controller and control_toolbox",
    100.0,
    _convert_ros2_controllers,
    _render_ros2_controllers,
    ("the planned reference, and without it feed-forward: an abrupt one would overshoot",),
    counts=False,
    known=KnownLoop(
        {
            "p": math.nan, "i": math.nan, "d": 0.0, "u_clamp_max": math.inf,
            "u_clamp_min": -math.inf, "tracking_time_constant": 0.0, "feedforward_gain": 0.0,
        },
        _start_ros2_controllers,
    ),
)  # fmt: skip


# linorobot2: PWM of wheel RPM, every 20 ms, one set for all wheels.
# github.com/linorobot/linorobot2_hardware (8a95745): config/lino_base_config.h (``K_P``, ``K_I``,
# ``K_D``, ``PWM_BITS``), firmware/lib/pid/pid.cpp, ``compute``, firmware/lib/encoder/encoder.h,
# ``getRPM``, firmware/src/firmware.ino (a timer of 20 ms). ``pwm = K_P e + K_I sum(e) + K_D (e -
# e_before)``, the sum with the present error and without a limit, emptied where set-point and
# error are both 0; the output is kept within ``PWM_MIN`` and ``PWM_MAX`` (``2^PWM_BITS - 1``) and
# cut to a whole number.


PWM_BITS = 10


def _convert_linorobot2(design: Design) -> Gains:
    loop, T = design.loop, design.loop.sample_time
    # PWM per RPM of the wheel, from volts per rad/s of the motor.
    scale = (2**PWM_BITS - 1) / loop.supply_voltage * loop.gear_ratio * 2 * math.pi / 60
    wanted = absorb_present_error(design.feedback, T)
    p, i = rounded(max(wanted.p, 0.0) * scale), rounded(wanted.i * T * scale)
    feedback = Feedback((p + i) / scale, i / T / scale)
    return Gains({"K_P": p, "K_I": i, "K_D": 0.0}, feedback)


def _start_linorobot2(setting: Setting) -> Step:
    n, full = setting.numbers, 2 ** setting.numbers["PWM_BITS"] - 1
    total = before = 0.0

    def step(setpoint: float, speed: float) -> float:
        nonlocal total, before
        error = setpoint - speed * 60 / (2 * math.pi)
        total, slope, before = total + error, error - before, error
        if setpoint == 0.0 and error == 0.0:
            total = slope = 0.0
        pwm = n["K_P"] * error + n["K_I"] * total + n["K_D"] * slope
        return int(min(max(pwm, -full), full)) / full * setting.supply

    return step


def _render_linorobot2(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    numbers = next(iter(gains.values())).numbers
    lines = [f"#define PWM_BITS {PWM_BITS}"]
    return "\n".join([*lines, *(f"#define {n} {v!r}" for n, v in numbers.items())]) + "\n"


LINOROBOT2 = Format(
    "linorobot2",
    "linorobot2 firmware (PWM of wheel RPM)",
    "github.com/linorobot/linorobot2_hardware",
    50.0,
    _convert_linorobot2,
    _render_linorobot2,
    ("feed-forward", "anti-windup", "the planned reference"),
    one_set=True,
    known=KnownLoop(
        {"K_P": math.nan, "K_I": math.nan, "K_D": 0.0, "PWM_BITS": PWM_BITS},
        _start_linorobot2,
        lambda numbers: 0.02,
    ),
)


# ros_arduino_bridge: integers, ticks per interval of 33 ms, one set for both wheels.
# github.com/hbrobotics/ros_arduino_bridge (a960c8a), ros_arduino_firmware, ROSArduinoBridge:
# diff_controller.h, ``doPID``: ``output += (Kp e - Kd (input - input_before) + ITerm) / Ko`` in
# whole numbers, at most 255; ROSArduinoBridge.ino: ``PID_INTERVAL = 1000 / PID_RATE`` in whole
# milliseconds, 33 of ``PID_RATE`` 30, and set-points in whole ticks per interval.
# ros_arduino_python, base_controller.py: the node sends its own ``Kp``, ``Kd``, ``Ki``, ``Ko``
# over those of the firmware. ``Kd (input - input_before)`` is a product of 16 bits on an AVR:
# ``Kd`` stays so small that a wheel blocked at full speed does not overflow it. It is a velocity
# algorithm: its ``Kp`` integrates, ``Kd`` is proportional action on the measurement, ``Ki`` would
# integrate twice and stays 0.


MAX_GAIN, INT16 = 1000, 32767


def _convert_ros_arduino_bridge(design: Design) -> Gains:
    loop, T = design.loop, design.loop.sample_time
    if not loop.count_angle:
        raise DesignError("ros_arduino_bridge counts ticks; give --counts-per-revolution")
    # PWM per tick in an interval, from volts per rad/s of the motor.
    scale = MAX_PWM / loop.supply_voltage / (ticks(loop) * T)
    # ``Kp`` takes the present error: so much less is left to the proportional action.
    integral = design.feedback.i * T * scale
    proportional = max(design.feedback.p - design.feedback.i * T, 0.0) * scale
    largest = min(MAX_GAIN, INT16 / (top_speed(design) * ticks(loop) * T))
    Ko = _find_divisor(integral, proportional, largest)
    Kp, Kd = max(round(integral * Ko), 1), round(proportional * Ko)
    kp, kd = Kp / Ko / scale, Kd / Ko / scale
    # The share of the present error is proportional action on the measurement, too.
    feedback = Feedback(kd + kp, kp / T)
    weight = kp / (kd + kp)
    rest = Ko / Kp / (ticks(loop) * T)
    return Gains(
        {"Kp": Kp, "Kd": Kd, "Ki": 0, "Ko": Ko}, feedback, weight, tracking=T, resting_error=rest
    )


def _start_ros_arduino_bridge(setting: Setting) -> Step:
    if math.isnan(setting.ticks):
        raise SignalError("ros_arduino_bridge counts ticks; give counts_per_revolution")
    n, per_interval = setting.numbers, setting.ticks * setting.sample_time
    output = before = term = 0

    def step(setpoint: float, speed: float) -> float:
        nonlocal output, before, term
        if setpoint == 0.0:
            output = before = term = 0
            return 0.0
        turned = round(speed * per_interval)
        error = round(setpoint) - turned
        output += int((n["Kp"] * error - n["Kd"] * (turned - before) + term) / n["Ko"])
        if abs(output) < MAX_PWM:
            term += int(n["Ki"] * error)
        output, before = min(max(output, -MAX_PWM), MAX_PWM), turned
        return output / MAX_PWM * setting.supply

    return step


def _find_divisor(integral: float, proportional: float, largest: float) -> int:
    """Return the ``Ko`` with the smallest rounding error of two integer gains."""
    most = max(min(int(largest / max(integral, proportional)), MAX_GAIN), 1)

    def error(Ko: int) -> float:
        one = abs(max(round(integral * Ko), 1) / (integral * Ko) - 1)
        other = abs(round(proportional * Ko) / (proportional * Ko) - 1) if proportional else 0.0
        return max(one, other)

    return min(range(1, most + 1), key=error)


def _pid_rate(milliseconds: int) -> int:
    """Return the ``PID_RATE`` that the firmware divides into an interval."""
    rate = 1000 // milliseconds
    if 1000 // rate != milliseconds:
        nearest = 1000 / (1000 // rate)
        raise DesignError(
            f"no PID_RATE gives an interval of {milliseconds} ms; --rate {nearest:.5g}"
        )
    return rate


def _render_ros_arduino_bridge(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    one, numbers = next(iter(designs.values())), next(iter(gains.values())).numbers
    milliseconds = whole_milliseconds(one.loop)
    lines = [f"#define PID_RATE {_pid_rate(milliseconds)}  // {milliseconds} ms"]
    lines += [f"int {n} = {int(v)};" for n, v in numbers.items()]
    lines.append("// The ROS node sends its own over these; in arduino_params.yaml:")
    return "\n".join([*lines, *(f"// {n}: {int(v)}" for n, v in numbers.items())]) + "\n"


ROS_ARDUINO_BRIDGE = Format(
    "ros_arduino_bridge",
    "ros_arduino_bridge (PWM of ticks per interval, integers)",
    "github.com/hbrobotics/ros_arduino_bridge, diff_controller.h",
    1000 / 33,
    _convert_ros_arduino_bridge,
    _render_ros_arduino_bridge,
    (
        "feed-forward",
        "the planned reference",
        "errors below Ko/Kp ticks an interval, which whole numbers round to nothing",
    ),
    one_set=True,
    known=KnownLoop(
        {"Kp": math.nan, "Kd": math.nan, "Ki": 0.0, "Ko": math.nan},
        _start_ros_arduino_bridge,
        lambda numbers: 0.033,
    ),
)


# Arduino PID_v1: PWM of wheel rad/s, proportional on error.
# github.com/br3ttb/Arduino-PID-Library 1.2.1, PID_v1.cpp, ``Compute``, ``SetTunings``: the sum of
# ``Ki T e``, with the present error, and the output are both kept within the limits; ``Kp`` on
# the error (``P_ON_E``), ``Kd`` on the measurement; ``T`` is ``SampleTime``, whole milliseconds.


def _convert_arduino_pid(design: Design) -> Gains:
    loop, T = design.loop, design.loop.sample_time
    scale = MAX_PWM / loop.supply_voltage * loop.gear_ratio
    wanted = absorb_present_error(design.feedback, T)
    p, i = rounded(max(wanted.p, 0.0) * scale), rounded(wanted.i * scale)
    feedback = Feedback((p + i * T) / scale, i / scale)
    numbers = {"Kp": p, "Ki": i, "Kd": 0.0, "SampleTime": whole_milliseconds(loop)}
    return Gains(numbers, feedback)


def _start_arduino_pid(setting: Setting) -> Step:
    n, T = setting.numbers, setting.sample_time
    total = before = 0.0

    def step(setpoint: float, speed: float) -> float:
        nonlocal total, before
        error, slope, before = setpoint - speed, speed - before, speed
        total = min(max(total + n["Ki"] * T * error, -MAX_PWM), MAX_PWM)
        pwm = n["Kp"] * error + total - n["Kd"] / T * slope
        return int(min(max(pwm, -MAX_PWM), MAX_PWM)) / MAX_PWM * setting.supply

    return step


def _render_arduino_pid(designs: Mapping[str, Design], gains: Mapping[str, Gains]) -> str:
    lines = []
    for wheel, one in gains.items():
        n, wheel = one.numbers, wheel.replace("/", "_")
        lines += [
            f"// {wheel}: input and set-point in rad/s of the wheel, output in PWM",
            f"PID {wheel}_pid(&{wheel}_speed, &{wheel}_pwm, &{wheel}_target, "
            f"{n['Kp']!r}, {n['Ki']!r}, {n['Kd']!r}, P_ON_E, DIRECT);",
            f"// in setup(): {wheel}_pid.SetOutputLimits(-{MAX_PWM}, {MAX_PWM}); "
            f"{wheel}_pid.SetSampleTime({n['SampleTime']}); {wheel}_pid.SetMode(AUTOMATIC);",
        ]
    return "\n".join(lines) + "\n"


ARDUINO_PID = Format(
    "arduino_pid",
    "Arduino PID_v1 (PWM of wheel rad/s)",
    "github.com/br3ttb/Arduino-PID-Library",
    100.0,
    _convert_arduino_pid,
    _render_arduino_pid,
    ("feed-forward", "the planned reference", "anti-windup beyond limits of the sum"),
    known=KnownLoop(
        {"Kp": math.nan, "Ki": math.nan, "Kd": 0.0, "SampleTime": math.nan},
        _start_arduino_pid,
        lambda numbers: 1e-3 * numbers["SampleTime"],
    ),
)


FORMATS: Mapping[str, Format] = {
    one.name: one for one in (ROS2_CONTROLLERS, LINOROBOT2, ROS_ARDUINO_BRIDGE, ARDUINO_PID)
}
"""Every target by its name."""
