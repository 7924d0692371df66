# SPDX-License-Identifier: Apache-2.0
"""The robot's body: kinematics, limits and odometry."""
