# SPDX-License-Identifier: Apache-2.0
"""The fixtures of the system tests."""

import os
from pathlib import Path

from threadpoolctl import threadpool_info


def is_running(pid: int) -> bool:
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


def test_every_started_process_is_ended_with_its_children(process, eventually):
    # The child ignores the interrupt, as a hanging node would.
    parent = process("sh", "-c", "trap '' INT; sleep 60 & echo $!; wait")
    eventually(lambda: parent.output.endswith("\n"))
    child = int(parent.output)
    assert is_running(child)
    parent.end()
    eventually(lambda: not is_running(child), deadline=2.0)


def test_each_process_inherits_a_domain_of_its_own_on_loopback(process, ros_domain):
    shown = process("sh", "-c", "echo $ROS_DOMAIN_ID $FASTRTPS_DEFAULT_PROFILES_FILE")
    assert shown.wait(5.0) == 0
    domain, profile = shown.output.split()
    assert (domain, Path(profile).name) == (str(ros_domain), "loopback.xml")
    assert os.environ["ROS_DOMAIN_ID"] == str(ros_domain)


def test_linear_algebra_of_tests_has_one_thread():
    assert {pool["num_threads"] for pool in threadpool_info()} == {1}
