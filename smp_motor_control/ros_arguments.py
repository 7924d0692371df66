# SPDX-License-Identifier: Apache-2.0
"""Separation of a program's arguments from those of ROS."""

from collections.abc import Sequence


def split_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a program's own arguments and those from ``--ros-args`` to ``--``."""
    own: list[str] = []
    ros: list[str] = []
    inside = False
    for argument in argv:
        inside = inside or argument == "--ros-args"
        (ros if inside else own).append(argument)
        inside = inside and argument != "--"
    return own, ros
