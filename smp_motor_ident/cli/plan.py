# SPDX-License-Identifier: Apache-2.0
"""Plan a commissioning: its steps, their durations and the remaining time, drawn as a table."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

import numpy as np

from smp_motor_control.excitation import SIGNALS as SHAPES
from smp_motor_ident.cli.steps import Excitation
from smp_motor_ident.infer.planning import what_next
from smp_motor_ident.limits import REQUIRED_ACCURACY
from smp_motor_ident.result import Estimate

FITTED, HELD_OUT = "excitation", "validation"
"""Folders of the recordings for identification and for validation."""

SIGNALS = (
    ("sine", 0.75, 1.0, FITTED),
    ("square", 0.75, 1.0, FITTED),
    ("fourier", 1.0, 1.0, FITTED),
    ("steps", 1.0, 0.5, HELD_OUT),
)
"""Excitations: signal, shares of amplitude and duration, and their recording."""

EXTRA = "further"  # name of a recording that the identification requests
# Parts after the recordings
IDENTIFYING, IDENTIFYING_AGAIN, TUNING = "identifying", "identifying again", "tuning"
DRIVING = "driving on the new gains"

MAX_EXTRA_S = 120.0  # of such a recording [s]
CHECK_S, START_S, COMPUTE_S, DRIVE_S = 8.0, 4.0, 4.0, 12.0
"""First guesses [s]: the test of one wheel, the start and end of processes around a signal, the
identification or tuning of one wheel, the drive."""

DRAWN_S, COLUMNS, BLOCKS = 4.0, 72, "▁▂▃▄▅▆▇█"
"""Drawn length of a signal [s], number of columns, and characters of the levels."""


@dataclass(frozen=True)
class Recording:
    """One signal and the folder of its recording."""

    folder: str  # :data:`FITTED` or :data:`HELD_OUT`
    name: str
    excitation: Excitation

    @property
    def part(self) -> str:
        """Name of the part in the schedule."""
        return f"exciting: {self.name}"

    def describe(self) -> str:
        """Return the signal as text."""
        one = self.excitation
        band = f", {one.band[0]:.2g} to {one.band[1]:.2g} Hz" if one.band else ""
        return f"{one.amplitude:.3g} V{band}, {one.duration:.3g} s"


def recordings(amplitude: float, duration: float) -> list[Recording]:
    """Return the recordings that every robot needs."""
    return [
        Recording(folder, signal, Excitation(signal, lasts * duration, share * amplitude))
        for signal, share, lasts, folder in SIGNALS
    ]


def plan_extra_recording(estimates: Mapping[str, Estimate], amplitude: float) -> Recording | None:
    """Return the recording that would reduce the uncertainty of these estimates, or None.

    The wheel that needs the longest recording decides.
    """
    proposals = [
        what_next(one, REQUIRED_ACCURACY, supply=amplitude, longest=MAX_EXTRA_S)
        for one in estimates.values()
        if _is_uncertain(one)
    ]
    if not proposals:
        return None
    longest = max(proposals, key=lambda one: one.duration)
    signal = Excitation("fourier", longest.duration, longest.amplitude, longest.band)
    return Recording(FITTED, EXTRA, signal)


def _is_uncertain(estimate: Estimate) -> bool:
    """Tell whether a quantity that gains depend on misses the required accuracy."""
    both = (estimate.combinations.get(name) for name in ("dc_gain", "time_constant"))
    return any(q and q.value and (q.std or 0.0) > REQUIRED_ACCURACY * abs(q.value) for q in both)


class Schedule:
    """Successive parts of a commissioning, and the remaining time.

    The time left of a part is the planned one plus the mean delay of finished parts of its kind.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._parts: dict[str, tuple[str, float]] = {}
        self._took: dict[str, float] = {}
        self._running: tuple[str, float] | None = None

    def add(self, name: str, kind: str, seconds: float) -> None:
        """Plan a part, replacing one of the same name."""
        self._parts[name] = kind, seconds

    def begin(self, name: str, how: str = "") -> str:
        """End the current part and begin a planned one; return its text with the time left."""
        if self._running is not None:
            before, since = self._running
            self._took[before] = self._clock() - since
        self._running = name, self._clock()
        text = f"{name}, {how}" if how else name
        number = len(self._took) + 1
        return f"[{number}/{len(self._parts)}] {text}; about {format_duration(self.left())} left"

    def left(self) -> float:
        """Return the time that is left [s]."""
        running, since = self._running or ("", 0.0)
        total = 0.0
        for name, (kind, planned) in self._parts.items():
            if name not in self._took:
                gone = self._clock() - since if name == running else 0.0
                total += max(planned + self._late(kind) - gone, 0.0)
        return total

    def _late(self, kind: str) -> float:
        done = [n for n in self._took if self._parts[n][0] == kind]
        return mean(self._took[n] - self._parts[n][1] for n in done) if done else 0.0


def schedule(
    wheels: Sequence[str],
    parts: Iterable[Recording],
    checked: bool = False,
    identified: bool = False,
    tuned: bool = False,
) -> Schedule:
    """Return the remaining parts of a commissioning."""
    made = Schedule()
    for wheel in () if checked else wheels:
        made.add(f"checking {wheel}", "check", CHECK_S)
    for part in parts:
        made.add(part.part, "signal", part.excitation.duration + START_S)
    if not identified:
        made.add(IDENTIFYING, "identify", COMPUTE_S * len(wheels))
    if not tuned:
        made.add(TUNING, "tune", COMPUTE_S * len(wheels))
    made.add(DRIVING, "drive", DRIVE_S)
    return made


def format_duration(seconds: float) -> str:
    """Return a rounded duration as text."""
    whole = round(seconds / 5) * 5 if seconds > 20 else round(seconds)
    return f"{whole // 60} min {whole % 60} s" if whole >= 60 else f"{whole} s"


def draw_plan(amplitude: float, duration: float, wheels: Sequence[str]) -> list[str]:
    """Return the plan as text, with the first seconds of each signal as a line of blocks."""
    lines = [
        f"first: each wheel alone, some {CHECK_S:g} s: slowly until it turns, then at growing "
        f"voltages up to {amplitude:g} V, both ways; signs, gearing, dead zone, supply and load "
        "are checked"
    ]
    begin, parts = 0.0, recordings(amplitude, duration)
    for one in parts:
        part = one.excitation
        signal = SHAPES[part.signal](amplitude=part.amplitude)
        shown = min(part.duration, DRAWN_S)
        level = signal(np.arange(COLUMNS, dtype=np.float64) * (shown / COLUMNS)) / part.amplitude
        bars = "".join(BLOCKS[round((1 + float(v)) / 2 * (len(BLOCKS) - 1))] for v in level)
        lines.append(
            f"from {begin:5.1f} s: {part.signal}, up to {part.amplitude:g} V either way, "
            f"{part.duration:g} s; its first {shown:g} s:"
        )
        lines.append(f"  {bars}")
        begin += part.duration
    total = format_duration(schedule(wheels, parts).left())
    accuracy = 100 * REQUIRED_ACCURACY
    lines += [
        f"then: identify; where a number is not known to {accuracy:g} %, one more Fourier signal "
        f"of at most {MAX_EXTRA_S:g} s; tune; a drive of some {DRIVE_S:g} s with the gains on "
        "trial",
        f"{begin:g} s of excitation, about {total} in all for {len(wheels)} wheels. "
        "Nothing was moved.",
    ]
    return lines
