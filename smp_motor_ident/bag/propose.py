# SPDX-License-Identifier: Apache-2.0
"""Propose a mapping by names, and keep it only if the signals behave accordingly.

Scales, such as the full scale of a PWM, are asked for and never guessed.  Where names do not
identify the time, the voltage or the motion of a table, the data decide.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.errors import is_ros_name
from smp_motor_ident.bag import axis, checks, decode, drives, mapping, names, read, storage
from smp_motor_ident.bag.clock import split_into_runs
from smp_motor_ident.bag.source import Recording, find_recordings
from smp_motor_ident.bag.tables import (
    MIN_TIMES_SINCE_1970,
    TIME_NAMES,
    is_time_of_part,
    plan_from_names,
)
from smp_motor_ident.bag.topics import Listing, Proposal, TopicInfo, describe_topics
from smp_motor_ident.bag.types import Types
from smp_motor_ident.bag.units import find_unit, needs
from smp_motor_ident.errors import BagError

_REASONS = {
    "supply_voltage": "in volts",
    "wheel_radius": "in metres, because the recording has the speed of the rim",
    "pole_pairs": "of the motor, because erpm counts electrical revolutions",
}
_MAX_SAMPLES = 20_000  # examined samples
_ROLES = ("voltage", *names.MOTIONS)
_MAX_UNNAMED_COLUMNS = 16  # columns tried if their names are not conclusive


@dataclass
class _Candidate:
    """A field that may be a signal of a wheel."""

    role: str
    info: TopicInfo
    path: str
    time: Array = field(default_factory=lambda: np.zeros(0))
    value: Array = field(default_factory=lambda: np.zeros(0))
    wheel: str = ""
    robot: str = ""

    @property
    def source(self) -> str:
        """Source as a mapping writes it, in quotes where it would be misread."""
        whole = self.info.topic or self.path
        if self.info.topic.startswith("/") and self.path != "value":
            whole = f"{self.info.topic}.{self.path}"
            signal = (
                mapping.parse_mapping([f"direction={whole}"]).motors["motor"].signals["direction"]
            )
            if signal == mapping.Signal(self.info.topic, self.path):
                return whole
        elif re.fullmatch(r"[\w()\[\]]+", whole):
            return whole
        return '"' + whole.replace('"', '""') + '"'

    @property
    def unit(self) -> str:
        """Unit that follows the source, by name; never a scale."""
        text = f"{self.info.topic}.{self.path}"
        if unit := find_unit(self.role, self.info.units.get(self.path, ""), text):
            return f":{unit}"
        likely = names.UNIT_HINTS.get(self.role, ())
        hint = next((unit for pattern, unit in likely if re.search(pattern, text, re.I)), "")
        whole = self.value[np.isfinite(self.value)]
        if self.role == "voltage" and not hint and whole.size:
            steps = np.array_equal(whole, np.rint(whole)) and np.abs(whole).max() > 48
            volts = re.search(names.WORDS_OF_VOLTS, text, re.IGNORECASE)
            hint = ":pwm" if steps and not volts else ""
        if self.role == "position" and not hint and _find_wrap(whole) == 360:
            hint = ":deg"
        if hint == ":duty" and np.abs(whole).max(initial=0.0) > 1:
            hint = ":pwm"  # the user must give its scale
        return hint


def list_topics(paths: Any, msg_files: Iterable[str] = ()) -> list[Listing]:
    """List the topics of recordings, and suggest mappings."""
    types = Types(msg_files)
    listings = []
    for recording in find_recordings(paths):
        with read.errors_in_one_line(recording):
            topics = describe_topics(recording, types)
            needed = all(info.type != read.STATE for info in topics)
            proposal = propose(recording, topics, types) if needed else Proposal()
            if proposal.suggestion:
                try:
                    read.read_recording(recording, _fill_placeholders(proposal), types)
                except BagError as error:
                    text = f"a mapping was proposed by names and cannot be read: {error}"
                    recording.findings.append(storage.note("proposal_failed", text))
                    proposal = Proposal(remark="no mapping is suggested that can be read")
        listings.append(Listing(
            name=recording.name, topics=topics, needs_mapping=needed,
            findings=recording.findings, **vars(proposal),
        ))  # fmt: skip
    return listings


def propose(recording: Recording, topics: list[TopicInfo], types: Types) -> Proposal:
    """Return the file's own mapping, or one by names that the data confirm where they can."""
    if own := _read_own_mapping(recording):
        return own
    apart = [[info] for info in topics] if any(o.table and o.count for o in topics) else [topics]
    proposals = [_by_names_and_data(recording, group, types) for group in apart]
    return next((p for p in proposals if p.suggestion), proposals[0])


def _by_names_and_data(recording: Recording, topics: list[TopicInfo], types: Types) -> Proposal:
    """Return a mapping by names and data for each group of fields."""
    time = _find_time_column(topics)
    fields = list(_collect_candidates(recording, topics, types, time))
    every = [c for c in fields if c.value.size]
    alone = recording.is_table and len(topics) == 1
    unnamed = [c for c in every if not c.role]
    if alone and time is None and (k := drives.find_clock([c.value for c in unnamed])) is not None:
        time = replace(unnamed[k], role="time")
    chosen, remarks = _select_by_names(every)
    if alone and not chosen and (pair := _select_by_data([c for c in every if c is not time])):
        chosen = [("", pair)]
        remarks = [f"by the data alone: {pair[1].source} follows {pair[0].source}; check both"]
    if not chosen:
        without = [c.source for c in fields if not c.value.size and c.role in _ROLES][:4]
        remarks += [f"{one} holds no number" for one in without]
        return Proposal(remark="; ".join([_explain_failure(fields), *remarks]))
    items = []
    for prefix, fields in chosen:
        items += [f"{prefix}{c.role}={c.source}{c.unit}" for c in fields]
    if time:
        items.append(f"time={time.source}{time.unit}")
    asked = _required_keys([c for _, fields in chosen for c in fields], time, recording.is_table)
    added = [f"{key}=… {why}" for key, why in asked.items()]
    return Proposal(suggestion=items, asked=added, remark="; ".join(remarks))


def _select_by_names(
    every: Sequence[_Candidate],
) -> tuple[list[tuple[str, list[_Candidate]]], list[str]]:
    """Return voltage and motions of each wheel by their names, and remarks on doubtful ones."""
    wheels: dict[tuple[str, str], list[_Candidate]] = {}
    for candidate in _assign_motors(_assign_robots(every)):
        wheels.setdefault((candidate.robot, candidate.wheel), []).append(candidate)
    found_by_wheel, remarks = [], []
    for (robot, wheel), fields in sorted(wheels.items()):
        ways = [c for c in fields if c.role == "direction"][:1]
        shared = wheels.get((robot, ""), []) if wheel else []
        voltages = [c for c in (*fields, *shared) if c.role == "voltage" and c.value.any()]
        voltages = [c for c in voltages if drives.find_clock([c.value]) is None]
        motions = [c for c in fields if c.role in names.MOTIONS]
        sizes = [c for c in voltages if ways and c.value.size and c.value.min() >= 0]
        chosen = []
        try:
            chosen = _select_voltage([_add_direction(c, ways[0]) for c in sizes], motions)
        except BagError as error:  # direction codes without a sign
            remarks.append(str(error))
        used = ways if chosen else []
        chosen = chosen or _select_voltage(voltages, motions)
        if not chosen and (chosen := _select_untestable(voltages, motions)):
            remarks.append(_remark_on_unconfirmed(chosen[0]))
        if chosen:
            if _is_torque(chosen[0]):
                remarks.append(
                    f"{chosen[0].source} is a torque [N m] by its message's documentation; map it "
                    "only if your driver writes its command there"
                )
            current = [c for c in fields if c.role == "current"][:1]
            name = "_".join(filter(None, (robot, wheel)))
            found_by_wheel.append((f"{name}." if name else "", [*chosen, *used, *current]))
    return found_by_wheel, remarks


def _assign_robots(every: Sequence[_Candidate]) -> list[_Candidate]:
    """Return fields with the namespace that tells robots, or motors, apart: ``/robot1/pwm``."""
    spaces: dict[tuple[str, str], set[str]] = {}
    for c in every:
        space, rest = _split_namespace(c)
        spaces.setdefault((rest, c.path), set()).add(space)
    apart = {space for several in spaces.values() if len(several) > 1 for space in several}
    robots = [space for space in apart if is_ros_name(space) and not names.find_side(space)]
    return [replace(c, robot=s) if (s := _split_namespace(c)[0]) in robots else c for c in every]


def _split_namespace(candidate: _Candidate) -> tuple[str, str]:
    """Return a topic's first name and its others; no first where it has one only."""
    parts = candidate.info.topic.split("/", 2)
    return (parts[1], parts[2]) if len(parts) == 3 and not parts[0] else ("", parts[-1])


def _is_torque(candidate: _Candidate) -> bool:
    return re.search(names.TORQUE_NAMES, candidate.path, re.IGNORECASE) is not None


def _assign_motors(every: Sequence[_Candidate]) -> list[_Candidate]:
    """Return fields with the motor or the run that their names tell apart.

    A name's ending identifies the motor (``velL``), a field's parent the run (``run_2.u``).
    """
    for tell in (names.find_motor, names.find_parent):
        named = [c if c.wheel else replace(c, wheel=tell(c.path)) for c in every]
        driven = {c.wheel for c in named if c.role == "voltage"}
        moved = {c.wheel for c in named if c.role in names.MOTIONS and c.wheel}
        apart = moved if "" in driven else moved & driven
        if len(apart) > 1:
            return [mine if mine.wheel in apart else c for mine, c in zip(named, every)]
    return list(every)


def _add_direction(voltage: _Candidate, way: _Candidate) -> _Candidate:
    """Return a magnitude of voltage with its direction; BagError if the codes have no sign."""
    size, direction = (axis.Series(c.time.astype(np.int64), c.value) for c in (voltage, way))
    return replace(voltage, value=checks.apply_direction(size, direction, way.source).value)


def _select_by_data(every: list[_Candidate]) -> list[_Candidate]:
    """Return a voltage and the motion that follows it best, if names do not identify both."""
    size = max((c.value.size for c in every), default=0)
    fields = [c for c in every if c.value.size == size][:_MAX_UNNAMED_COLUMNS]
    unnamed = [c for c in fields if not c.role]
    voltages = [c for c in fields if c.role == "voltage"] or unnamed
    motions = [c for c in fields if c.role in names.MOTIONS] or unnamed
    best, pair = 0.0, []
    for u, y in product(voltages, motions) if unnamed else ():
        drive, moved = u.value[:_MAX_SAMPLES], y.value[:_MAX_SAMPLES]
        share, summed = (0.0, False) if u is y else drives.compute_following_share(drive, moved)
        steps = np.diff(moved, prepend=moved[:1]) if summed else moved
        if share > best and drives.compute_unexplained_share(drive, steps) is not None:
            way = "count" if np.array_equal(y.value, np.rint(y.value)) else "position"
            way = y.role or (way if summed else "velocity")
            best, pair = share, [replace(u, role="voltage"), replace(y, role=way)]
    return pair


def _required_keys(
    chosen: list[_Candidate], time: _Candidate | None, table: bool
) -> dict[str, str]:
    """Return the keys that the user must add to a mapping, with reasons."""
    asked: dict[str, str] = {}
    units = [c.unit for c in chosen]
    if ":pwm" in units:
        largest = max(np.nanmax(np.abs(c.value)) for c in chosen if c.unit == ":pwm")
        asked["pwm_full_scale"] = f"the value that is 100 % (the largest here is {largest:g})"
    for key, reason in _REASONS.items():
        if any(needs(c.role, c.unit[1:], key) for c in chosen):
            asked[key] = reason
    if any(c.role == "count" or c.unit.startswith(":ticks") for c in chosen):
        asked["counts_per_revolution"] = "of the motor shaft"
    speed = next((c for c in chosen if c.role == "velocity" and not c.unit), None)
    words = names.split_words(speed.path) if speed else ""
    if table and speed and not re.search(names.WORDS_OF_RADIANS, words, re.I):
        asked["velocity"] = (
            f"its unit, {speed.source}:rpm or {speed.source}:deg/s, unless it is rad/s "
            f"(position={speed.source} if it is an angle)"
        )
    if time is None:
        asked |= {"sample_time": "in seconds, between rows: no column is a time"} if table else {}
    elif not time.unit and time.value.size > 1:
        step = float(np.nanmedian(np.diff(time.value)))
        # Later times tell their unit.
        if step >= 1 and np.nanmax(time.value) < MIN_TIMES_SINCE_1970[-1][0]:
            asked["time"] = f"its unit, {time.source}:ms or :us (it rises by {step:g} a row)"
    return asked


def _read_own_mapping(recording: Recording) -> Proposal | None:
    """Return the mapping of a table whose columns have the names and units of signals."""
    if not recording.is_table:
        return None
    try:
        plans = plan_from_names(recording, mapping.SignalMap())
    except BagError:
        return None
    items, rim = [], False
    for wheel, plan in plans.items():
        for name, signal in plan.signals.items():
            prefix = f"{wheel}." if name != "time" and wheel != mapping.DEFAULT_MOTOR else ""
            source = f"{signal.topic}.{signal.field}" if signal.topic else signal.field
            items.append(f"{prefix}{name}={source}" + (f":{signal.unit}" if signal.unit else ""))
            rim |= needs(name, signal.unit, "wheel_radius")
    asked = [f"wheel_radius=… {_REASONS['wheel_radius']}"] if rim else []
    alone = "wheel_radius alone is enough" if rim else "no mapping is needed"
    remark = f"the file says this itself: {alone}"
    return Proposal(suggestion=list(dict.fromkeys(items)), asked=asked, remark=remark)


def _select_untestable(voltages: list[_Candidate], motions: list[_Candidate]) -> list[_Candidate]:
    """Return a voltage that changes too seldom for a test, and a motion, by their names."""
    seldom = [c for c in voltages if np.count_nonzero(np.diff(c.value)) < drives.COMMAND_LAGS]
    moving = [
        c for role in names.MOTIONS for c in motions if c.role == role and np.ptp(c.value) > 0
    ]
    return [seldom[0], moving[0]] if seldom and moving else []


def _remark_on_unconfirmed(voltage: _Candidate) -> str:
    """Return the remark on a voltage that the data cannot confirm."""
    times = np.count_nonzero(np.diff(voltage.value))
    how = f"changes {times} time{'s' * (times > 1)} only" if times else "is constant"
    unconfirmed = "so the data cannot confirm that it drives the motor"
    return f"{voltage.source} {how}, {unconfirmed}; it was chosen by its name alone"


def _explain_failure(fields: list[_Candidate]) -> str:
    """Return the reason for the missing proposal."""
    roles = {c.role for c in fields}
    missing = [] if "voltage" in roles else ["a voltage"]
    missing += [] if roles & set(names.MOTIONS) else ["a motion"]
    if missing:
        return f"no field is called {' or '.join(missing)}"
    return "no field that is called a voltage explains one that is called a motion"


def _fill_placeholders(proposal: Proposal) -> mapping.SignalMap:
    """Return the mapping of a proposal, with placeholders for the values the user must add."""
    unit = ":ms" if any(text.startswith("time=") for text in proposal.asked) else ""
    given = mapping.parse_mapping(
        [i + unit if i.startswith("time=") else i for i in proposal.suggestion]
    )
    hardware = {"supply_voltage": 12.0, "counts_per_revolution": 1.0}
    some: Any = dict(pwm_full_scale=1e9, wheel_radius=1.0, sample_time=1.0, pole_pairs=1.0)
    motors = {w: replace(one, hardware=hardware, **some) for w, one in given.motors.items()}
    return replace(given, motors=motors)


def _find_time_column(topics: list[TopicInfo]) -> _Candidate | None:
    """Return the column of time of a table."""
    columns = ((info, path) for info in topics if info.table for path in info.fields)
    named = (c for c in columns if c[1] != "value" and re.search(TIME_NAMES, c[1], re.IGNORECASE))
    return next((_Candidate("time", info, path) for info, path in named), None)


def _collect_candidates(
    recording: Recording, topics: list[TopicInfo], types: Types, time: _Candidate | None
) -> Iterator[_Candidate]:
    """Yield the fields with a role by name, and the others of a table."""
    named: list[tuple[str, TopicInfo, str]] = []
    for info in topics:
        place = names.find_pose_fields(info.fields)
        for path in info.fields:
            if (time and path == time.path) or is_time_of_part(path) or path in place:
                continue
            role = names.find_role(info.topic, path)
            barred = names.is_excluded(role, f"{info.type} {info.topic} {path}")
            if (role or info.table) and not barred:
                named.append((role, info, path))
    wanted: dict[str, list[str]] = {}
    for _, info, path in named:
        wanted.setdefault(info.topic, []).append(path)
    if time is not None and time.info.topic in wanted:
        wanted[time.info.topic].append(time.path)
    tables = decode.collect(recording, wanted, types)
    for role, info, path in named:
        table = tables[info.topic]
        if path not in table.columns:
            continue
        value = table.columns[path].astype(np.float64)
        clock = table.stamp if table.stamp is not None and table.stamp.all() else table.log
        if clock is None and time is not None and time.path in table.columns:
            clock = time.value = table.columns[time.path]
            if len(split_into_runs(clock, {})) > 1:  # in the order in which they were written
                clock = None
        at = np.arange(value.size) if clock is None else clock
        there = table.present.get(path)
        kept = np.isfinite(value) & (True if there is None else there)
        wheel = names.find_side(f"{info.topic}.{path}")
        value, times = value[kept], at.astype(np.float64)[kept]
        whole = np.array_equal(value, np.rint(value))
        role = "position" if role == "count" and not whole else role
        if not (role == "voltage" and _is_supply(path, value)):
            yield _Candidate(role, info, path, times, value, wheel)


def _find_wrap(angle: Array) -> float:
    """Return the turn at which an angle wraps, in radians or degrees; 0 if it does not."""
    span, jump = np.ptp(angle) if angle.size else 0.0, np.abs(np.diff(angle)).max(initial=0.0)
    return next((turn for turn in (2 * np.pi, 360.0) if span <= turn and jump > turn / 2), 0.0)


def _is_supply(name: str, value: Array) -> bool:
    """Return whether a voltage is a supply by its name and never falls to half its maximum."""
    size = np.abs(value)
    named = re.search(names.SUPPLY_NAMES, names.split_words(name), re.IGNORECASE)
    return bool(named and size.size and 0 < size.max() < 2 * size.min())


def _select_voltage(voltages: list[_Candidate], motions: list[_Candidate]) -> list[_Candidate]:
    """Return the voltage that explains a motion best, and all motions that it explains.

    Of two similar fits, a voltage in volts precedes a duty cycle.  A command without the name of a
    drive must leave half of the residual; a torque is taken if nothing else explains a motion.
    """
    torques = [c for c in voltages if _is_torque(c)]
    if torques and (others := [c for c in voltages if c not in torques]):
        return _select_voltage(others, motions) or _select_voltage(torques, motions)
    best: list[_Candidate] = []
    least = np.inf
    for voltage in sorted(voltages, key=lambda c: needs("voltage", c.unit[1:], "supply_voltage")):
        explained = [
            (c, rest) for c in motions if (rest := _unexplained_share(voltage, c)) is not None
        ]
        if not explained:
            continue
        rest = min(rest for _, rest in explained)
        handicap = 1 if names.names_voltage(voltage.source) else 2
        if handicap * rest * (1 + 1 / voltage.value.size) < least:
            least = handicap * rest
            first = {c.role: c for c, left in reversed(explained) if left < 2 * rest}
            best = [voltage, *(first[role] for role in names.MOTIONS[::-1] if role in first)]
    return best


def _unexplained_share(voltage: _Candidate, motion: _Candidate) -> float | None:
    """Return the share of the motion that a voltage leaves unexplained; None where it does not."""
    order = np.argsort(motion.time, kind="stable")[:_MAX_SAMPLES]
    y = motion.value[order]
    if voltage.time.size < 2:
        return None
    ranked = np.argsort(voltage.time, kind="stable")
    index = np.searchsorted(voltage.time[ranked], motion.time[order], "right") - 1
    u = voltage.value[ranked][np.maximum(index, 0)]
    if motion.role != "velocity":
        turn = _find_wrap(y) if motion.role == "position" else 0.0
        steps = np.diff(np.unwrap(y, period=turn) if turn else y, prepend=y[:1])
        summed, itself = (drives.compute_lagged_share(u, x) for x in (steps, y))
        if itself > summed:  # counts of an interval are a speed
            return None
        y = steps
    return drives.compute_unexplained_share(u, y)
