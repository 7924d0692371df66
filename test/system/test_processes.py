"""The fixtures that the system tests stand on."""

from __future__ import annotations

import os
import sys


def test_every_started_process_is_ended_with_its_children(process, eventually):
    child = "import subprocess, sys; p = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']); print(p.pid); p.wait()"
    parent = process(sys.executable, "-c", child)
    eventually(lambda: parent.output.strip().isdigit())
    parent.end()
    grandchild = int(parent.output)

    def gone() -> bool:
        try:
            state = open(f"/proc/{grandchild}/stat").read().rsplit(")", 1)[1].split()[0]
        except FileNotFoundError:
            return True
        return state == "Z"

    eventually(gone, deadline=2.0)


def test_each_process_inherits_a_domain_of_its_own_on_loopback(process, ros_domain):
    shown = process("sh", "-c", "echo $ROS_DOMAIN_ID $ROS_AUTOMATIC_DISCOVERY_RANGE")
    assert shown.wait(5.0) == 0
    assert shown.output.split() == [str(ros_domain), "LOCALHOST"]
    assert os.environ["ROS_DOMAIN_ID"] == str(ros_domain)
