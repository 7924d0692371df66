"""A mapping proposed by names, kept only where the signals behave as what they are called.

A voltage explains the speed: its past predicts the speed better than the speed's own past does
(Granger's test, an F test of two nested regressions).  What decides of units, such as the full
scale of a PWM, is asked for and never guessed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import fdtrc

from smp_motor_ident.bag.decode import collect
from smp_motor_ident.bag.limits import EXPLAINS
from smp_motor_ident.bag.mapping import DEFAULT_MOTOR, SignalMap, parse
from smp_motor_ident.bag.offers import Listing, Offer, offers_of
from smp_motor_ident.bag.read import STATE, one_line, read_recording
from smp_motor_ident.bag.runs import runs
from smp_motor_ident.bag.source import Recording, recordings
from smp_motor_ident.bag.storage import Array, found
from smp_motor_ident.bag.tables import TIME_NAMES, self_described
from smp_motor_ident.bag.types import Types
from smp_motor_ident.bag.units import of_the_rim, written_or_named
from smp_motor_ident.errors import BagError

_ROLES = {
    # What a field or its topic is called, the most telling first.
    "voltage": r"volt|spannung|tension|napi[eę]cie|напряж|电压|電圧|pwm|duty|throttle"
    r"|(?:^|\W|_)(?:cmd|command|effort|u|input)(?:$|\W|_)",
    "current": r"current|strom|courant|corriente|corrente|(?:^|\W)ток|电流|電流"
    r"|amp(?:s|ere)?(?:$|\W|_)",
    "count": r"tick|count|encoder|impuls|(?:^|\W|_)enc(?:$|\W|_)",
    "velocity": r"rpm|velo[cz]i|speed|omega|drehzahl|geschwindigkeit|vitesse|pr[eę]dko|скорост|速度"
    r"|(?:^|\W|_)(?:vel|w|y)(?:$|\W|_)",
    "position": r"position|posici|posizi|angle|winkel|theta|угол|角度|(?:^|\W|_)pos(?:$|\W|_)",
}
_MOTIONS = ("velocity", "position", "count")
_NO_VOLTAGE = r"twist|cmd_vel|linear|angular|batter|supply|vbat|vin(?:$|\W|_)"
_NO_MOTION = r"set_?point|target|desired|reference|soll|cmd|command"
_HINTS = (
    ("velocity", r"rpm|drehzahl", ":rpm"),
    ("velocity", r"deg", ":deg/s"),
    ("position", r"deg", ":deg"),
    ("voltage", r"duty", ":duty"),
    ("voltage", r"pwm|throttle", ":pwm"),
)
_SIDES = ("front", "rear", "back", "left", "right", "fl", "fr", "rl", "rr", "bl", "br")
_RADIUS = "in metres: what is measured is the way of the rim"
_MOST = 20_000
"""Samples that are looked at."""
_LAGS, _OWN = 6, 2
_WORDS_OF_VOLTS = r"volt|spannung|tension|napi|напряж|电压|電圧"


@dataclass
class _Candidate:
    """A field that may be a signal of a wheel."""

    role: str
    wheel: str
    offer: Offer
    path: str
    time: Array
    value: Array

    @property
    def source(self) -> str:
        if self.offer.topic.startswith("/") and self.path != "value":
            return f"{self.offer.topic}.{self.path}"
        whole = self.offer.topic or self.path
        return whole if re.fullmatch(r"[\w()\[\]]+", whole) else f'"{whole}"'

    @property
    def unit(self) -> str:
        """What follows the source: a unit by name, never a scale."""
        text = f"{self.offer.topic}.{self.path}"
        if unit := written_or_named(self.role, self.offer.units.get(self.path, ""), text):
            return f":{unit}"
        hint = _hint(self.role, text)
        whole = self.value[np.isfinite(self.value)]
        if self.role == "voltage" and not hint and whole.size:
            steps = np.array_equal(whole, np.rint(whole)) and np.abs(whole).max() > 48
            hint = ":pwm" if steps and not re.search(_WORDS_OF_VOLTS, text, re.IGNORECASE) else ""
        if hint == ":duty" and np.abs(whole).max(initial=0.0) > 1:
            hint = ":pwm"  # of a scale that is asked for
        return hint


def list_topics(paths: Any, msg_files: Iterable[str] = ()) -> list[Listing]:
    """List what recordings offer, and suggest how to map it."""
    types = Types(msg_files)
    listings = []
    for recording in recordings(paths):
        with one_line(recording):
            offers = offers_of(recording, types)
            needed = all(offer.type != STATE for offer in offers)
            proposal = propose(recording, offers, types) if needed else Proposal()
            if proposal.items:
                try:
                    read_recording(recording, _filled(proposal.items), types, None)
                except BagError as error:
                    text = f"a mapping was proposed by names and cannot be read: {error}"
                    recording.findings.append(found("proposal_failed", text))
                    proposal = Proposal(remark="no mapping is suggested that can be read")
        listings.append(
            Listing(
                recording.name,
                offers,
                proposal.items,
                proposal.asked,
                needed,
                recording.findings,
                proposal.remark,
            )
        )
    return listings


@dataclass(frozen=True)
class Proposal:
    """Items for ``--map`` that read a recording."""

    items: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)  # what the user must add to them
    remark: str = ""  # why there are none, or what the data could not confirm


def propose(recording: Recording, offers: list[Offer], types: Types) -> Proposal:
    """Return what the file says itself, or a mapping by names that the data confirm if they can."""
    if own := _of_the_file(recording):
        return own
    time = _time(offers)
    wheels: dict[str, list[_Candidate]] = {}
    for candidate in _candidates(recording, offers, types, time):
        wheels.setdefault(candidate.wheel, []).append(candidate)
    shared = [c for c in wheels.get("", []) if c.role == "voltage"]
    items: list[str] = []
    asked: dict[str, str] = {}
    remarks: list[str] = []
    for wheel, fields in sorted(wheels.items()):
        voltages = [c for c in fields if c.role == "voltage"] or shared
        motions = [c for c in fields if c.role in _MOTIONS]
        chosen = _explained(voltages, motions)
        if not chosen and (chosen := _untestable(voltages, motions)):
            remarks.append(_unconfirmed(chosen[0]))
        if not chosen:
            continue
        chosen += [c for c in fields if c.role == "current"][:1]
        prefix = f"{wheel}." if wheel else ""
        items += [f"{prefix}{c.role}={c.source}{c.unit}" for c in chosen]
        voltage = chosen[0]
        if voltage.unit == ":pwm":
            largest = np.nanmax(np.abs(voltage.value))
            asked["pwm_full_scale"] = f"the value that is 100 % (the largest here is {largest:g})"
        if voltage.unit in (":pwm", ":duty", ":%"):
            asked["supply_voltage"] = "in volts"
        if any(of_the_rim(c.role, c.unit[1:]) for c in chosen):
            asked["wheel_radius"] = _RADIUS
    if not items:
        return Proposal(remark=_reason([c for fields in wheels.values() for c in fields]))
    if time:
        items.append(f"time={time.source}{time.unit}")
    return Proposal(items, [f"{key}=… {why}" for key, why in asked.items()], "; ".join(remarks))


def _of_the_file(recording: Recording) -> Proposal | None:
    """Return the mapping of a table that names its columns and units as the signals are."""
    if not recording.is_table:
        return None
    try:
        plans = self_described(recording, recording.channels(), SignalMap())
    except BagError:
        return None
    items, rim = [], False
    for wheel, plan in plans.items():
        for name, signal in plan.signals.items():
            prefix = f"{wheel}." if name != "time" and wheel != DEFAULT_MOTOR else ""
            source = f"{signal.topic}.{signal.field}" if signal.topic else signal.field
            items.append(f"{prefix}{name}={source}" + (f":{signal.unit}" if signal.unit else ""))
            rim |= of_the_rim(name, signal.unit)
    asked = [f"wheel_radius=… {_RADIUS}"] if rim else []
    alone = "wheel_radius alone is enough" if rim else "no mapping is needed"
    return Proposal(list(dict.fromkeys(items)), asked, f"the file says this itself: {alone}")


def _untestable(voltages: list[_Candidate], motions: list[_Candidate]) -> list[_Candidate]:
    """Return a voltage that changes less often than a test needs, and a motion, by their names."""
    seldom = [c for c in voltages if c.value.size and _changes(c) < _LAGS]
    moving = [c for role in _MOTIONS for c in motions if c.role == role and np.ptp(c.value) > 0]
    return [seldom[0], moving[0]] if seldom and moving else []


def _changes(voltage: _Candidate) -> int:
    return int(np.count_nonzero(np.diff(voltage.value)))


def _unconfirmed(voltage: _Candidate) -> str:
    """Return what the data could not tell of a voltage."""
    times = _changes(voltage)
    how = f"changes {times} time{'s' * (times > 1)} only" if times else "is constant"
    return (
        f"{voltage.source} {how}, so that the data cannot confirm that it drives the motor; "
        "this is by the names alone"
    )


def _reason(fields: list[_Candidate]) -> str:
    """Return why nothing is proposed."""
    roles = {c.role for c in fields}
    missing = [] if "voltage" in roles else ["a voltage"]
    missing += [] if roles & set(_MOTIONS) else ["a motion"]
    if missing:
        return f"no field is called {' or '.join(missing)}"
    return "no field that is called a voltage explains one that is called a motion"


def _filled(items: Sequence[str]) -> SignalMap:
    """Return the mapping of a proposal, with any value for what the user must add."""
    given = parse(items)
    motors = {
        wheel: replace(
            motor, hardware={"supply_voltage": 12.0}, pwm_full_scale=1.0, wheel_radius=1.0
        )
        for wheel, motor in given.motors.items()
    }
    return replace(given, motors=motors)


def _time(offers: list[Offer]) -> _Candidate | None:
    """Return the column of time of a table."""
    for offer in offers:
        for path in offer.fields if offer.table else []:
            if path != "value" and re.search(TIME_NAMES, path, re.IGNORECASE):
                empty = np.zeros(0)
                return _Candidate("time", "", offer, path, empty, empty)
    return None


def _candidates(
    recording: Recording, offers: list[Offer], types: Types, time: _Candidate | None
) -> Iterator[_Candidate]:
    """Yield the fields whose names say what they may be, with their values."""
    named: list[tuple[str, Offer, str]] = []
    for offer in offers:
        for path in offer.fields:
            if time is not None and path == time.path:
                continue
            role, text = _role(offer.topic, path), f"{offer.type} {offer.topic} {path}"
            barred = _NO_VOLTAGE if role == "voltage" else _NO_MOTION if role in _MOTIONS else "^$"
            if role and not re.search(barred, text, re.IGNORECASE):
                named.append((role, offer, path))
    wanted: dict[str, list[str]] = {}
    for _, offer, path in named:
        wanted.setdefault(offer.topic, []).append(path)
    if time is not None and time.offer.topic in wanted:
        wanted[time.offer.topic].append(time.path)
    tables = collect(recording, wanted, types)
    for role, offer, path in named:
        table = tables[offer.topic]
        if path not in table.columns:
            continue
        value = table.columns[path].astype(np.float64)
        clock = table.stamp if table.stamp is not None and table.stamp.all() else table.log
        if clock is None and time is not None and time.path in table.columns:
            clock = table.columns[time.path]
            if len(runs(clock, {})) > 1:  # in the order in which they were written
                clock = None
        at = np.arange(value.size) if clock is None else clock
        there = table.present.get(path)
        kept = np.isfinite(value) & (True if there is None else there)
        wheel = _wheel(f"{offer.topic}.{path}")
        yield _Candidate(role, wheel, offer, path, at.astype(np.float64)[kept], value[kept])


def _explained(voltages: list[_Candidate], motions: list[_Candidate]) -> list[_Candidate]:
    """Return the voltage that explains a motion best, and the motions that it explains."""
    best: list[_Candidate] = []
    least = np.inf
    for voltage in voltages:
        moved = [(c, _rest(voltage, c)) for c in motions]
        explained = [(c, rest) for c, rest in moved if rest is not None]
        if explained and explained[0][1] < least:
            least = explained[0][1]
            first = {c.role: c for c, _ in reversed(explained)}
            best = [voltage, *(first[role] for role in _MOTIONS[::-1] if role in first)]
    return best


def _rest(voltage: _Candidate, motion: _Candidate) -> float | None:
    """Return the share of the motion that a voltage leaves unexplained; None where it does not."""
    order = np.argsort(motion.time, kind="stable")[:_MOST]
    y = motion.value[order]
    if motion.role != "velocity":
        y = np.diff(y, prepend=y[:1])
    if voltage.time.size < 2 or y.size < 5 * (_LAGS + _OWN):
        return None
    ranked = np.argsort(voltage.time, kind="stable")
    index = np.searchsorted(voltage.time[ranked], motion.time[order], "right") - 1
    u = voltage.value[ranked][np.maximum(index, 0)]
    y, u = y - y.mean(), u - u.mean()
    if not (np.std(y) > 0 and np.std(u) > 0):
        return None
    y, u = y / np.std(y), u / np.std(u)
    begin = max(_LAGS, _OWN)
    own = [y[begin - k : y.size - k] for k in range(1, _OWN + 1)]
    driven = [u[begin - k : u.size - k] for k in range(_LAGS)]
    target = y[begin:]
    rests = []
    for columns in (own, own + driven):
        matrix = np.stack([*columns, np.ones(target.size)], axis=1)
        solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
        rests.append(float(np.sum((target - matrix @ solution) ** 2)) + 1e-12)
    free = target.size - _OWN - _LAGS - 1
    ratio = (rests[0] - rests[1]) / _LAGS / (rests[1] / free)
    return rests[1] / rests[0] if fdtrc(_LAGS, free, ratio) < EXPLAINS.value else None


def _role(topic: str, path: str) -> str:
    """Return what a field is by its own name, or else by its topic's."""
    for text in (path.partition("[")[0], topic):
        for role, pattern in _ROLES.items():
            if re.search(pattern, text, re.IGNORECASE):
                return role
    return ""


def _hint(role: str, source: str) -> str:
    for wanted, pattern, text in _HINTS:
        if wanted == role and re.search(pattern, source, re.IGNORECASE):
            return text
    return ""


def _wheel(source: str) -> str:
    """Return the side of the robot that a name tells."""
    words = re.split(r"[^a-z]+", source.lower())
    return "_".join(side for side in _SIDES if side in words)
