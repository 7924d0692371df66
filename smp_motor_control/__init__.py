"""Running DC-motor wheels: motor, encoder, PID, profiles and kinematics as pure mathematics.

ROS nodes that wrap them live in :mod:`smp_motor_control.nodes`; nothing else here knows ROS.
"""

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""The four wheels in the paper's order: motors 1, 2, 3 and 4."""
