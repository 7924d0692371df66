# SPDX-License-Identifier: Apache-2.0
"""Summarise a motor: verdict, main numbers and reasons."""

import shlex
from dataclasses import dataclass

from smp_motor_ident.finding import SEVERITIES, Finding
from smp_motor_ident.report.words import is_stated, label_in_sentence, to_sentence
from smp_motor_ident.result import Estimate, Quantity

MAX_MESSAGES = 3  # largest number of messages shown unfolded for a motor


@dataclass(frozen=True)
class Message:
    """A finding in words, with its number among those of the motor, from 1."""

    number: int
    severity: str
    text: str
    advice: str


def select_messages(estimate: Estimate) -> tuple[list[Message], list[Message]]:
    """Return the messages that are shown for a motor, the gravest first, and the folded ones."""
    told = [
        Message(k, finding.severity, to_sentence(finding.message), to_sentence(finding.advice))
        for k, finding in enumerate(_by_severity(estimate), 1)
    ]
    shown = min(sum(one.severity != "note" for one in told), MAX_MESSAGES)
    return told[:shown], told[shown:]


def _by_severity(estimate: Estimate) -> list[Finding]:
    return sorted(estimate.findings, key=lambda f: -SEVERITIES.index(f.severity))


def _list_stated(estimate: Estimate) -> list[str]:
    """Return the names of the quantities of a motor that have a value or a range."""
    every = {**estimate.combinations, **estimate.parameters}
    return [name for name, quantity in every.items() if is_stated(quantity)]


def find_doubted(estimate: Estimate) -> dict[str, int]:
    """Return the unreliable quantities, each with the number of its message."""
    doubted, known = dict[str, int](), _list_stated(estimate)
    for number, finding in enumerate(_by_severity(estimate), 1):
        if finding.severity in ("unreliable", "refused"):
            # A finding that names no quantity concerns all.
            affected = [name for name in known if name in finding.quantities] or known
            doubted = {**dict.fromkeys(affected, number), **doubted}
    return doubted


def judge(estimate: Estimate) -> tuple[str, str]:
    """Return the grade of a motor, ``good``, ``fair`` or ``poor``, and the verdict in words."""
    percent = estimate.fit_percent.validation
    if estimate.unreliable:
        doubted = find_doubted(estimate)
        every = len(doubted) == len(_list_stated(estimate))
        which = "every number" if every else ", ".join(map(label_in_sentence, doubted))
        return "poor", f"Unreliable: {which}"
    warnings = sum(f.severity == "warning" for f in estimate.findings)
    if warnings:
        return "fair", f"Usable, with {warnings} warning{'s' if warnings > 1 else ''}"
    return ("fair", "Not tested: no data was held out") if percent is None else ("good", "Reliable")


def describe_fit(estimate: Estimate) -> str:
    """Return the fit of the simulated speed in words."""
    known = (
        (estimate.fit_percent.validation, "on held-out data"),
        (estimate.fit_percent.estimation, "on the data of the fit"),
    )
    parts = [f"{percent:.1f} % {where}" for percent, where in known if percent is not None]
    return f"Fit of the simulated speed: {', '.join(parts)}." if parts else ""


def advise_tuning(estimate: Estimate, folder: str) -> tuple[str, str]:
    """Return advice on gains, and the command that designs them from the folder of results."""
    if estimate.combinations.get("dc_gain", Quantity(None)).value is None:
        return "No gains: these data do not determine the DC gain.", ""
    command = f"tune {shlex.quote(folder)} --output gains.yaml"
    if not estimate.hardware.supply_voltage:
        command += " --supply VOLTS"
    if estimate.unreliable:
        return (
            "Design gains, slow ones because the estimate is unreliable, with",
            f"{command} --accept-unreliable",
        )
    return "Design gains with", command
