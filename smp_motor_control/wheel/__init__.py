# SPDX-License-Identifier: Apache-2.0
"""Speed loop, protection and fault handling of one wheel, without ROS."""
