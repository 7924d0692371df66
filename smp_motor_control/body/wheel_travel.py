# SPDX-License-Identifier: Apache-2.0
"""Wheel travel from samples that may be lost or wrong."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

MAX_EXTRAPOLATION_S = 0.1
"""Longest interval over which a velocity is extrapolated where the position is missing."""

STAMP_JITTER_S = 0.02
"""Tolerated error of a stamp, including the angle of one count over a short interval."""

CLOCK_JUMP_S = 1.0
"""A stamp that is earlier by more shows that a clock was set; by less, a late sample."""

UNFILLED_ANGLE = 1.0
"""Integrated velocity [rad] after which a constant position counts as not filled in."""

REVOLUTION = 2.0 * math.pi


class WheelSample(NamedTuple):
    """One wheel at one instant."""

    stamp: float  # instant of sampling [s]
    # position, velocity: [rad], [rad/s]
    position: float
    velocity: float


class SideTravel(NamedTuple):
    """Travel and speed of both sides."""

    # left, right: mean over the side's wheels since the previous call [rad]
    left: float
    right: float
    # left_speed, right_speed: mean over the side's wheels of the speed over a window [rad/s]
    left_speed: float
    right_speed: float


class WheelTravel:
    """Travel of one wheel since its first sample, from position or, without one, velocity.

    A jump of the position is ignored unless the next sample confirms it, which shows a counter
    reset.  A jump by one revolution is a wrap; a position that never changes was not filled in.
    """

    def __init__(self, first: WheelSample, angle: float = 0.0) -> None:
        self.latest, self.angle = first, angle  # newest accepted sample; travel since the first
        self.jumps = self.wraps = 0  # resets and wraps of the position
        self._suspect: WheelSample | None = None
        self._unmoved: float | None = 0.0  # integrated velocity at constant position [rad]
        self._past: deque[WheelSample] = deque([first])

    @property
    def problem(self) -> str:
        """Fault of the position and its remedy; empty without a fault."""
        if self._is_unfilled():
            return "position never changes while the wheel turns: the driver must fill it in"
        if self.wraps:
            return f"position wraps ({self.wraps} times): the driver must unwrap it"
        if self.jumps:
            return (
                f"position jumped {self.jumps} times: look for counter resets or a second publisher"
            )
        return ""

    def restart(self, sample: WheelSample) -> None:
        """Continue from a sample of another counter, without travel."""
        self.latest, self._suspect = sample, None
        self._past = deque([sample])

    def add(self, sample: WheelSample, max_speed: float) -> bool:
        """Add a sample; return whether it was accepted.

        A change faster than ``max_speed`` [rad/s] is a jump.
        """
        last = self.latest
        dt = sample.stamp - last.stamp
        if dt < -CLOCK_JUMP_S:
            self.restart(sample)
        if dt <= 0.0:
            return False
        extrapolated = (
            sample.velocity * min(dt, MAX_EXTRAPOLATION_S)
            if math.isfinite(sample.velocity)
            else 0.0
        )
        moved = sample.position - last.position
        if math.isfinite(moved):
            self._check_position_moves(moved, extrapolated)
        if not math.isfinite(moved) or self._is_unfilled():
            moved = extrapolated
        allowed = max_speed * (dt + STAMP_JITTER_S)
        if abs(moved) > allowed:
            unwrapped = moved - math.copysign(REVOLUTION, moved)
            if abs(unwrapped) <= allowed and abs(moved) <= REVOLUTION + allowed:
                self.wraps += 1
            elif self._is_confirmed(sample, max_speed):
                unwrapped = extrapolated
                self.jumps += 1
            else:
                self._suspect = sample
                return False
            moved = unwrapped
            self._past.clear()
        self._suspect, self.latest = None, sample
        self.angle += moved
        self._past.append(sample)
        return True

    def speed(self, window: float) -> float:
        """Return the mean speed over the last ``window`` seconds, or since the oldest sample."""
        past, latest = self._past, self.latest
        while len(past) > 1 and past[1].stamp <= latest.stamp - window:
            past.popleft()
        span, angle = latest.stamp - past[0].stamp, latest.position - past[0].position
        known = span > 0.0 and math.isfinite(angle) and not self._is_unfilled()
        return angle / span if known else latest.velocity

    def forget_speed(self) -> None:
        """Restart the averaging window, as after a silence."""
        self._past = deque([self.latest])

    def _is_unfilled(self) -> bool:
        return self._unmoved is not None and abs(self._unmoved) > UNFILLED_ANGLE

    def _check_position_moves(self, moved: float, extrapolated: float) -> None:
        """Integrate the velocity while the position is constant."""
        if moved != 0.0:
            self._unmoved = None
        elif self._unmoved is not None:
            before = self._is_unfilled()
            self._unmoved += extrapolated
            if self._is_unfilled() and not before:
                self.angle += self._unmoved - extrapolated  # the caller adds this sample

    def _is_confirmed(self, sample: WheelSample, max_speed: float) -> bool:
        doubted = self._suspect
        if doubted is None or sample.stamp <= doubted.stamp:
            return False
        allowed = max_speed * (sample.stamp - doubted.stamp + STAMP_JITTER_S)
        return abs(sample.position - doubted.position) <= allowed


class _Wheel:
    """State of one wheel of a side."""

    def __init__(self) -> None:
        self.travel: WheelTravel | None = None
        self.arrived = -math.inf
        self.heard = False  # since the previous call of take
        # Angle at that call, and the same moved with its side while silent
        self.taken = self.extrapolated = 0.0

    def angle(self, *, silent: bool) -> float:
        """Return the travel since the first sample [rad], extrapolated while silent."""
        return self.extrapolated if silent or self.travel is None else self.travel.angle


class WheelFeedback:
    """Collect the feedback of all wheels; average speeds over ``window`` seconds."""

    def __init__(
        self,
        left: Sequence[str],
        right: Sequence[str],
        max_speed: float = math.inf,
        window: float = 0.2,
    ) -> None:
        self.left, self.right, self.max_speed = tuple(left), tuple(right), max_speed
        self.window = window
        self._wheels = {wheel: _Wheel() for wheel in (*self.left, *self.right)}
        self._totals = [0.0, 0.0]  # travel of the sides at the previous call of take

    def receive(
        self, wheel: str, sample: WheelSample, steady_now: float, restarted: bool = False
    ) -> None:
        """Add a sample, ignoring one without a finite number.

        The position of a ``restarted`` publisher has a new origin.
        """
        if not (math.isfinite(sample.position) or math.isfinite(sample.velocity)):
            return
        known = self._wheels[wheel]
        if known.travel is None:
            known.travel = WheelTravel(sample, known.extrapolated)
            known.taken, known.arrived = known.extrapolated, steady_now
            return
        if sample.stamp == known.travel.latest.stamp:
            return  # a duplicate does not show that the wheel is alive
        known.arrived = steady_now
        if restarted:
            known.travel.restart(sample)
        elif known.travel.add(sample, self.max_speed):
            known.heard = True

    def silent(self, steady_now: float, timeout: float) -> dict[str, float]:
        """Return the silence [s] of each wheel that exceeds the time-out."""
        ages = {wheel: steady_now - known.arrived for wheel, known in self._wheels.items()}
        return {wheel: age for wheel, age in ages.items() if age > timeout}

    @property
    def latest(self) -> Mapping[str, WheelSample]:
        """The newest sample of every wheel with feedback so far."""
        return {w: k.travel.latest for w, k in self._wheels.items() if k.travel is not None}

    @property
    def problems(self) -> dict[str, str]:
        """Faults of the wheels' positions and their remedies."""
        found = {w: k.travel.problem for w, k in self._wheels.items() if k.travel is not None}
        return {wheel: problem for wheel, problem in found.items() if problem}

    def take(self, steady_now: float, timeout: float) -> SideTravel | None:
        """Return both sides' travel since the previous result; None while a side is silent.

        A silent wheel is assumed to turn like the others of its side; its position corrects this
        when it returns.
        """
        silent = self.silent(steady_now, timeout)
        for wheel in silent:
            if (travel := self._wheels[wheel].travel) is not None:
                travel.forget_speed()
        sides = [[self._wheels[w] for w in side] for side in (self.left, self.right)]
        alive = [[self._wheels[w] for w in s if w not in silent] for s in (self.left, self.right)]
        if not all(alive) or not any(known.heard for side in alive for known in side):
            return None
        for side, living in zip(sides, alive):
            _extrapolate_silent(side, living)
        totals = [
            sum(self._wheels[w].angle(silent=w in silent) for w in side) / len(side)
            for side in (self.left, self.right)
        ]
        left, right = (now - before for now, before in zip(totals, self._totals))
        self._totals = totals
        speeds = (
            sum(k.travel.speed(self.window) for k in living if k.travel) / len(living)
            for living in alive
        )
        return SideTravel(left, right, *speeds)


def _extrapolate_silent(side: Sequence[_Wheel], living: Sequence[_Wheel]) -> None:
    """Move wheels without a new sample by the mean of the others of their side."""
    moved = {id(known): known.angle(silent=False) - known.taken for known in living}
    for known in side:
        others = [way for key, way in moved.items() if key != id(known)]
        if known.heard:
            known.extrapolated = known.angle(silent=False)
        elif others:
            known.extrapolated += sum(others) / len(others)
    for known in side:
        known.taken, known.heard = known.angle(silent=False), False
