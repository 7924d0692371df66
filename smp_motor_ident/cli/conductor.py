"""The tools' end of :mod:`smp_motor_control.nodes.conductor`: ROS without importing it."""

from __future__ import annotations

import json
import select
import time
from typing import Any

from smp_motor_ident.cli.processes import ProcessError, Processes


class Conductor:
    """Asks the conductor process, which speaks ROS.

    Parameters
    ----------
    processes : Processes
        In which it is started.
    name : str
        Under which it is known there.
    """

    def __init__(self, processes: Processes, name: str = "conductor") -> None:
        self._processes = processes
        self._name = name
        self._process = processes.start(name, "conductor", pipes=True)

    def ask(self, do: str, *, patience: float = 60.0, **request: Any) -> dict[str, Any]:
        """Have one request done.

        Parameters
        ----------
        do : str
            Name of the request, see :mod:`smp_motor_control.nodes.conductor`.
        patience : float
            Longest wait [s] for the answer.
        **request
            What the request needs.

        Returns
        -------
        dict
            The answer.

        Raises
        ------
        ProcessError
            When it could not be done, or a process ended meanwhile.
        """
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        try:
            stdin.write(json.dumps({"do": do, **request}).encode() + b"\n")
            stdin.flush()
        except BrokenPipeError:
            self._processes.check()
        deadline = time.monotonic() + patience
        while not select.select([stdout], [], [], 0.1)[0]:
            self._processes.check()
            if time.monotonic() > deadline:
                raise ProcessError(f"no answer to {do} within {patience:.0f} s")
        line = stdout.readline()
        if not line:
            raise ProcessError(f"{self._name} ended: {self._processes.last_words(self._name)}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise ProcessError(str(answer["error"]))
        return answer
