"""What a commissioning has found so far: written after every step, and what it stops at."""

import contextlib
import json
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from smp_motor_control.errors import SmpError
from smp_motor_ident.cli.processes import ProcessError
from smp_motor_ident.diagnosis.wheel_test import Figures
from smp_motor_ident.finding import Finding
from smp_motor_ident.report import commissioning as page
from smp_motor_ident.report.document import now, write_together
from smp_motor_ident.result import plain, to_json
from smp_motor_ident.tune.verification import Change

SCHEMA = 1
NAME, REPORT = "commissioning.json", "report.html"


class Protocol:
    """Findings, figures and verdict in ``commissioning.json`` and a page, gone on with if there."""

    def __init__(self, folder: Path, accepted: Sequence[str] = ()) -> None:
        self._folder, self._accepted = folder, tuple(accepted)
        self._changes: list[Change] = []
        self.document: dict[str, Any] = {"schema": SCHEMA}
        if (folder / NAME).is_file():
            self.document = json.loads((folder / NAME).read_text("utf-8"))
        self.document |= {"passed": None, "verdict": "It was cut off.", "accepted": [*accepted]}

    def begin(self, wheels: Sequence[str], asked: Mapping[str, Any]) -> None:
        """Forget what was found before: the wheels move anew."""
        self.document |= {
            "wheels": list(wheels), "asked": asked, "checked": False, "findings": [], "changes": [],
        }  # fmt: skip

    @property
    def checked(self) -> bool:
        """Whether the wheels were checked, and nothing stopped at that."""
        return bool(self.document.get("checked"))

    def checks(self, figures: Mapping[str, Figures], amplitude: float, speed: float) -> None:
        """Note what the test of the wheels showed, as :class:`~.checking.Checked` has it."""
        self.document |= plain({"checks": figures, "amplitude": amplitude, "speed": speed})

    def changes(self, changes: Sequence[Change]) -> None:
        """Note what a drive showed."""
        self._changes = list(changes)
        self.document["changes"] = [
            dict(wheel=one.wheel, name=one.name, setpoint=one.setpoint)
            | dict(reading=plain(one.reading), allowed=plain(one.bands))
            for one in changes
        ]

    def add(self, step: str, findings: Iterable[Finding]) -> list[Finding]:
        """Note and print findings; return those that a commissioning stops at."""
        new = list(findings)
        kept = [f for f in self.document.get("findings", []) if f["step"] != step]
        self.document["findings"] = kept + [{"step": step, **plain(f)} for f in new]
        for finding in new:
            print(f"{finding.severity}: {finding.message}", flush=True)
        return [f for f in new if f.severity == "refused" and f.code not in self._accepted]

    def warned_of(self, wheels: Container[object]) -> list[Finding]:
        """Return what earlier steps warned of these wheels: it may be the reason."""
        return [
            Finding(f["code"], "warning", f["message"], f["evidence"], f["advice"])
            for f in self.document["findings"]
            if f["severity"] == "warning" and f["evidence"].get("wheel") in wheels
        ]

    def stop(self, findings: Sequence[Finding]) -> None:
        """Write the verdict and raise, where there is something to stop at."""
        if findings:
            what = "; ".join(dict.fromkeys(f.message for f in findings))
            advice = "; ".join(dict.fromkeys(f.advice for f in findings if f.advice))
            self.end(False, f"stopped: {what}")
            raise ProcessError(f"stopped: {what}. What to do: {advice}")

    @contextlib.contextmanager
    def ending(self) -> Iterator[None]:
        """Let whatever ends the block otherwise than at a finding stand in the protocol."""
        try:
            yield
        except SmpError as error:
            if self.document["passed"] is None:
                self.end(False, f"stopped: {error}")
            raise

    def end(self, passed: bool, verdict: str) -> None:
        """Write the verdict."""
        self.document |= {"passed": passed, "verdict": verdict}
        self.write()

    def write(self) -> None:
        """Write both files, or none."""
        self.document["date"] = now()
        shown = page.render(self.document, self._changes)
        files = {self._folder / NAME: to_json(self.document), self._folder / REPORT: shown}
        write_together(files, force=True)
