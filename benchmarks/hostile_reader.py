# SPDX-License-Identifier: Apache-2.0
"""Read each file that standard input names in a process of its own, for hostile.py.

A line in holds path, mapping, limit of address space [byte] and of time [s]; a line out the
output of the process, its exit code and the memory [kB] that it took.  Processes are forked, so
what they import is loaded once.
"""

import json
import os
import resource
import signal
import sys
import tempfile

from smp_motor_ident.bag import list_topics, read_records
from smp_motor_ident.errors import BagError, SignalError


def read(path: str, mapping: list[str]) -> None:
    """List and read a file; print a line for each with its processor time."""
    for call in (lambda: list_topics(path), lambda: read_records(path, mapping)):
        begin, told = os.times(), "answer"
        try:
            call()
        except (BagError, SignalError) as error:
            told = str(error)
        taken = sum(b - a for a, b in zip(begin[:4], os.times()[:4]))
        print(f"{taken:.1f} s: {told}", flush=True)
        if "is not read after" in told:
            break  # the other call waits for the same process as long


for line in sys.stdin:
    path, mapping, space, seconds = json.loads(line)
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if not child:
            os.dup2(out.fileno(), 1)
            os.dup2(err.fileno(), 2)
            resource.setrlimit(resource.RLIMIT_AS, (space, space))
            signal.alarm(seconds)
            read(path, mapping)
            sys.exit()
        _, status, used = os.wait4(child, 0)
        texts = [(stream.seek(0), stream.read().decode())[1] for stream in (out, err)]
    print(json.dumps([*texts, os.waitstatus_to_exitcode(status), used.ru_maxrss]), flush=True)
