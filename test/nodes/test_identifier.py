# SPDX-License-Identifier: Apache-2.0
"""identifier as its own process, on a plant that excite drives."""

import math
import signal

from rclpy.qos import DurabilityPolicy, QoSProfile

from smp_interfaces.msg import MotorParameters

TRUE_GAIN = 25.548
"""DC gain of motor 1, K / (R b + K^2) from Table 1 [rad/s/V]."""


def test_accurate_estimate_is_published_after_sufficient_excitation(process, robot, eventually):
    heard: list[MotorParameters] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot.node.create_subscription(
        MotorParameters, "/front_left/motor_parameters", heard.append, latched
    )
    process("motor_plant")
    settings = ["-p", "period:=1.0", "-p", "window:=12.0", "-p", "wheels:=[front_left]"]
    identifier = process("identifier", "--ros-args", *settings)
    eventually(lambda: heard, 30.0, robot.spin, "nothing heard")
    # At rest: the status lists the missing excitation, and there are no values.
    eventually(lambda: "turned for 0.0" in heard[-1].status, 10.0, robot.spin, "no reason")
    assert all(not m.names and m.status.startswith("collecting") for m in heard)
    assert math.isnan(heard[-1].fit_percent)

    excite = ["-p", "wheels:=[front_left]", "-p", "duration:=15.0", "-p", "amplitude:=9.0"]
    process("excite", "--ros-args", *excite)
    eventually(lambda: heard[-1].names, 60.0, robot.spin, "no estimate")
    found = heard[-1]
    assert found.status.split(":")[0] in ("valid", "unreliable")
    assert found.joint_name == "front_left_wheel_joint"
    k = found.names.index("dc_gain")
    error = abs(found.values[k] - TRUE_GAIN)
    # Five standard deviations, or 0.5 % on a machine that is too busy to keep the plant's time.
    assert error < max(5 * found.std_devs[k], 0.005 * TRUE_GAIN)
    assert found.fit_percent > 80.0

    identifier.send_signal(signal.SIGINT)
    assert identifier.wait(5.0) == 0
