# SPDX-License-Identifier: Apache-2.0
"""URDF of a box on any number of wheels, for robot_state_publisher."""

from collections.abc import Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from smp_motor_control import get_joint_name

WIDTH_PER_RADIUS = 0.4  # width of a wheel and height of the box, in wheel radii; for display only


def robot_description(
    left: Sequence[str], right: Sequence[str], *, separation: float = 0.4, radius: float = 0.1
) -> str:
    """Return a URDF with the joints of ``joint_states``.

    ``base_link`` is midway between the sides, at the height of the axles.  Wheels of one side are
    three radii apart, the first in front.
    """
    robot = Element("robot", name="wheels")
    longest = 3 * radius * max(len(left), len(right))
    size = f"{longest:g} {separation - WIDTH_PER_RADIUS * radius:g} {WIDTH_PER_RADIUS * radius:g}"
    _add_visual(SubElement(robot, "link", name="base_link"), "box", size=size)
    for names, side in ((left, 0.5), (right, -0.5)):
        for k, wheel in enumerate(names):
            ahead = 3 * radius * ((len(names) - 1) / 2 - k)
            link = SubElement(robot, "link", name=f"{wheel}_wheel")
            rolled = f"{1.5707963:g} 0 0"  # from the cylinder's axis z to the wheel's axis y
            _add_visual(
                link,
                "cylinder",
                rolled,
                radius=f"{radius:g}",
                length=f"{WIDTH_PER_RADIUS * radius:g}",
            )
            joint = SubElement(robot, "joint", name=get_joint_name(wheel), type="continuous")
            SubElement(joint, "parent", link="base_link")
            SubElement(joint, "child", link=f"{wheel}_wheel")
            SubElement(joint, "origin", xyz=f"{ahead:g} {side * separation:g} 0")
            SubElement(joint, "axis", xyz="0 1 0")
    return ElementTree.tostring(robot, encoding="unicode")


def _add_visual(link: Element, shape: str, rpy: str = "0 0 0", **size: str) -> None:
    visual = SubElement(link, "visual")
    SubElement(visual, "origin", rpy=rpy)
    SubElement(SubElement(visual, "geometry"), shape, size)
