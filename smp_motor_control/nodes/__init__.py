# SPDX-License-Identifier: Apache-2.0
"""ROS nodes: thin shells around the ROS-free core."""
