# SPDX-License-Identifier: Apache-2.0
"""Store the findings of a commissioning after every step."""

import contextlib
import json
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from smp_motor_control.errors import SmpError
from smp_motor_ident.cli.processes import ProcessError
from smp_motor_ident.commission.wheel_test import Figures
from smp_motor_ident.finding import Finding
from smp_motor_ident.report import commissioning as page
from smp_motor_ident.report.document import now, read_identification, write_together
from smp_motor_ident.result import plain, to_json
from smp_motor_ident.tune.verification import Change

SCHEMA = 1
NAME, REPORT = "commissioning.json", "report.html"
PARTS = ("checked", "identified", "judged", "tuned")
"""Parts of a commissioning that ``--resume`` skips once they are done."""

SUMMARY = ("DC gain", "Time constant", "Static voltage", "p", "i", "d", "Settles, driven")
"""Rows of the page that the terminal shows."""


class CommissioningLog:
    """Findings, figures and verdict in ``commissioning.json`` and a page; resumed if present."""

    def __init__(self, folder: Path, accepted: Sequence[str] = ()) -> None:
        self._folder, self._accepted = folder, tuple(accepted)
        self._changes: list[Change] = []
        self.document: dict[str, Any] = {"schema": SCHEMA}
        if (folder / NAME).is_file():
            self.document = json.loads((folder / NAME).read_text("utf-8"))
        drove = self.document.get("passed") and self.document.get("changes")
        self.passed_verdict = str(self.document["verdict"]) if drove else ""
        self.document |= {
            "passed": None,
            "verdict": "The run was interrupted.",
            "accepted": [*accepted],
        }

    def begin(self, wheels: Sequence[str], asked: Mapping[str, Any]) -> None:
        """Clear earlier results before the wheels move again."""
        self.document |= {
            "wheels": list(wheels), "asked": asked, "findings": [], "changes": [],
            **dict.fromkeys(PARTS, False),
        }  # fmt: skip
        self.passed_verdict = ""

    def has(self, part: str) -> bool:
        """Return whether one of :data:`PARTS` is done."""
        return bool(self.document.get(part))

    def mark(self, **done: bool) -> None:
        """Write which parts are done, so that ``--resume`` skips them."""
        self.document |= done
        self.write()

    def store_checks(self, figures: Mapping[str, Figures], amplitude: float, speed: float) -> None:
        """Record the results of the wheel checks, see :class:`~.checking.CheckResult`."""
        self.document |= plain({"checks": figures, "amplitude": amplitude, "speed": speed})

    def store_changes(self, changes: Sequence[Change]) -> None:
        """Record the responses of a drive."""
        self._changes = list(changes)
        self.document["changes"] = [
            dict(wheel=one.wheel, name=one.name, setpoint=one.setpoint)
            | dict(reading=plain(one.reading), expected=plain(one.expected))
            | dict(allowed=plain(one.bands), tolerance=one.tolerance)
            for one in changes
        ]

    def add(self, step: str, findings: Iterable[Finding]) -> list[Finding]:
        """Store and print findings; return those that stop a commissioning."""
        new = list(findings)
        kept = [f for f in self.document.get("findings", []) if f["step"] != step]
        self.document["findings"] = kept + [{"step": step, **plain(f)} for f in new]
        for finding in new:
            print(f"{finding.severity}: {finding.message}", flush=True)
        return self.find_blocking(step)

    def find_blocking(self, step: str) -> list[Finding]:
        """Return the findings of a step that stop a commissioning."""
        return self._noted(
            lambda f: (
                f["step"] == step and f["severity"] == "refused" and f["code"] not in self._accepted
            )
        )

    def find_warnings(self, wheels: Container[object]) -> list[Finding]:
        """Return earlier warnings on these wheels, as possible reasons."""
        return self._noted(
            lambda f: f["severity"] == "warning" and f["evidence"].get("wheel") in wheels
        )

    def _noted(self, wanted: Callable[[dict[str, Any]], bool]) -> list[Finding]:
        return [
            Finding(f["code"], f["severity"], f["message"], f["evidence"], f["advice"])
            for f in self.document.get("findings", [])
            if wanted(f)
        ]

    def stop_on(self, findings: Sequence[Finding]) -> None:
        """Write the verdict and raise, if a finding stops the commissioning."""
        if findings:
            what = "; ".join(dict.fromkeys(f.message for f in findings))
            advice = "; ".join(dict.fromkeys(f.advice for f in findings if f.advice))
            self.store_verdict(False, f"stopped: {what}")
            raise ProcessError(f"stopped: {what}. What to do: {advice}")

    @contextlib.contextmanager
    def store_error(self) -> Iterator[None]:
        """Record an error or interruption that ends the block."""
        try:
            yield
        except SmpError as error:
            if self.document["passed"] is None:
                self.store_verdict(False, f"stopped: {error}")
            raise

    def store_verdict(self, passed: bool, verdict: str) -> None:
        """Write the verdict."""
        self.document |= {"passed": passed, "verdict": verdict}
        self.write()

    def write(self) -> None:
        """Write both files, or none."""
        self.document["date"] = now()
        gains = (self._folder / "gains.yaml").read_text("utf-8") if self.has("tuned") else ""
        shown = page.render(self.document, self._changes, self.results(), gains)
        files = {self._folder / NAME: to_json(self.document), self._folder / REPORT: shown}
        write_together(files, force=True)

    def results(self) -> page.Results:
        """Return the drive, gains and motors found so far."""
        if not self.has("identified"):
            return {}
        read = read_identification(self._folder / "identification")
        estimates = {wheel: read[wheel] for wheel in self.document["wheels"]}
        gains = {}
        if self.has("tuned"):
            gains = json.loads((self._folder / "gains.json").read_text("utf-8"))["wheels"]
        return page.results(estimates, gains, self.document["changes"])

    def summary(self) -> Iterator[str]:
        """Yield the main results, one line per wheel."""
        rows = [row for group in self.results().values() for row in group if row.name in SUMMARY]
        for k, wheel in enumerate(self.document["wheels"]):
            yield f"{wheel}: {'; '.join(row.tell(k) for row in rows)}"
