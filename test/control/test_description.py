# SPDX-License-Identifier: Apache-2.0
"""The URDF moves with joint_states, for any number of wheels."""

from xml.etree import ElementTree

import pytest

from smp_motor_control import LEFT, RIGHT, get_joint_name
from smp_motor_control.body.description import robot_description


@pytest.mark.parametrize(
    ("left", "right"), [(LEFT, RIGHT), (("left",), ("right",)), (("a", "b", "c"), ("d", "e", "f"))]
)
def test_urdf_has_one_joint_per_wheel_on_its_side(left, right):
    robot = ElementTree.fromstring(robot_description(left, right, separation=0.3, radius=0.05))
    joints = {joint.attrib["name"]: joint for joint in robot.iter("joint")}
    assert list(joints) == [get_joint_name(wheel) for wheel in (*left, *right)]
    links = [link.attrib["name"] for link in robot.iter("link")]
    assert len(set(links)) == len(links) == 1 + len(joints)
    for wheel in (*left, *right):
        joint = joints[get_joint_name(wheel)]
        x, y, z = map(float, joint.find("origin").attrib["xyz"].split())
        assert y == pytest.approx(0.15 if wheel in left else -0.15)
        assert z == 0.0
        # A positive turn about y rolls forward, as a positive set-point does (REP-103).
        assert joint.find("axis").attrib["xyz"] == "0 1 0"
        assert joint.find("parent").attrib["link"] == "base_link"
        assert joint.find("child").attrib["link"] in links
    ahead = [float(joints[get_joint_name(w)].find("origin").attrib["xyz"].split()[0]) for w in left]
    assert ahead == sorted(ahead, reverse=True)
    assert sum(ahead) == pytest.approx(0.0)
