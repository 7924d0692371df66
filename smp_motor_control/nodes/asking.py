"""Asks other nodes' services, parameters above all, until they answer."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python

ANSWER = 0.25
"""Time in which a service answers, or is asked again [s]."""

GET, SET = "get_parameters", "set_parameters_atomically"


class AskError(Exception):
    """What was not answered or was refused, in a line for the user."""


class Asker:
    """Keeps clients, and asks several nodes at once.

    Parameters
    ----------
    node : Node
        Whose clients these are.
    until : callable
        From a condition and a time-out [s]: spins the node until the condition holds.
    patience : float
        Longest wait for an answer [s]; on a busy machine discovery takes seconds.
    """

    def __init__(
        self, node: Node, until: Callable[[Callable[[], bool], float], bool], patience: float
    ) -> None:
        self._node, self._until, self._patience = node, until, patience
        self._clients: dict[str, Any] = {}

    def client(self, kind: Any, name: str) -> Any:
        """Return the client of a service: known to it early, an answer is not lost on the way."""
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, name)
        return self._clients[name]

    def ask_all(
        self, kind: Any, requests: Mapping[str, Any], *, again: float = ANSWER
    ) -> dict[str, Any]:
        """Ask services at once; return the answers by the services' names.

        An answer is lost where the node has not yet discovered this client: who does not answer
        is asked ``again`` after so long, so the request must do no harm twice.
        """
        clients = {name: self.client(kind, name) for name in requests}
        asked: dict[str, list[Any]] = {name: [] for name in requests}

        def answered(name: str) -> bool:
            return any(future.done() for future in asked[name])

        def all_answered() -> bool:
            return all(map(answered, requests))

        end = time.monotonic() + self._patience
        while not all_answered() and time.monotonic() < end:
            for name, request in requests.items():
                if not answered(name) and clients[name].service_is_ready():
                    asked[name].append(clients[name].call_async(request))
            waited = again if any(asked.values()) else ANSWER
            self._until(all_answered, min(waited, max(end - time.monotonic(), 0.0)))
        missing = [name for name in requests if not answered(name)]
        for name, futures in asked.items():
            for future in futures:
                if not future.done():
                    clients[name].remove_pending_request(future)
        if missing:
            there = all(asked[name] for name in missing)
            what = "no answer" if there else "no such service"
            owners = sorted({name.rpartition("/")[0].rpartition("/")[2] for name in missing})
            hint = "" if there else f"; is {', '.join(owners)} running?"
            names = ", ".join(clients[name].srv_name for name in missing)
            raise AskError(f"{names}: {what} within {self._patience:g} s{hint}")
        return {n: next(f for f in asked[n] if f.done()).result() for n in requests}

    def get_parameters(self, nodes: Mapping[str, Sequence[str]]) -> dict[str, dict[str, Any]]:
        """Return the parameters of nodes by name; those that are not set are left out."""
        requests = {
            f"{node}/{GET}": GetParameters.Request(names=list(names))
            for node, names in nodes.items()
        }
        answers = self.ask_all(GetParameters, requests)
        return {
            node: {
                name: parameter_value_to_python(value)
                for name, value in zip(names, answers[f"{node}/{GET}"].values, strict=False)
                if value.type != ParameterType.PARAMETER_NOT_SET
            }
            for node, names in nodes.items()
        }

    def set_parameters(self, nodes: Mapping[str, Mapping[str, Any]]) -> None:
        """Set parameters of nodes, all of a node at once or none."""
        requests = {
            f"{node}/{SET}": SetParametersAtomically.Request(
                parameters=[Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
            )
            for node, values in nodes.items()
        }
        answers = self.ask_all(SetParametersAtomically, requests)
        refused = [
            f"{node} refused the parameters: {answers[f'{node}/{SET}'].result.reason}"
            for node in nodes
            if not answers[f"{node}/{SET}"].result.successful
        ]
        if refused:
            raise AskError("; ".join(refused))
