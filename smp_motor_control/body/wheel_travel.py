"""How far the wheels have turned since last asked, from samples that may be lost or wrong."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

LONGEST_GUESS = 0.1
"""For so long [s] a wheel without a position is taken to have kept its velocity."""

JITTER = 0.02
"""By so much stamps may be off [s], beside what a count adds to the angle of a short interval."""

CLOCK_JUMP = 1.0
"""Stamps that go back by more are of a clock that was set; by less they are late ones [s]."""

UNFILLED = 1.0
"""Angle by the velocity [rad] over which a position that never changes is not the wheel's."""

TURN = 2.0 * math.pi


class WheelSample(NamedTuple):
    """One wheel at one instant."""

    stamp: float  # instant of sampling [s]
    # position, velocity: [rad], [rad/s]
    position: float
    velocity: float


class SideTravel(NamedTuple):
    """How far the wheels of both sides turned, and how fast they turn."""

    # left, right: mean over the side's wheels since it was last asked for [rad]
    left: float
    right: float
    # left_speed, right_speed: mean over the side's wheels [rad/s]; of each its travel over a
    # window, over the time between the stamps of the window's ends
    left_speed: float
    right_speed: float


class WheelTravel:
    """How far one wheel has turned since its first sample, by position or else by velocity.

    A position that jumps is left out, unless the next one is there, too: then its counter was
    reset.  One that goes back by a turn wraps, and one that never changes was not filled.

    Attributes
    ----------
    angle : float
        Way since the first sample [rad].
    latest : WheelSample
        The newest sample that is believed.
    jumps, wraps : int
        How often the position began anew, and wrapped.
    """

    def __init__(self, first: WheelSample, angle: float = 0.0) -> None:
        self.latest, self.angle = first, angle
        self.jumps = self.wraps = 0
        self._doubted: WheelSample | None = None
        self._unmoved: float | None = 0.0  # by the velocity, while the position stays [rad]
        self._past: deque[WheelSample] = deque([first])

    @property
    def problem(self) -> str:
        """What is wrong with the position, and what to do about it; empty where nothing is."""
        if self._is_unfilled():
            return "position never changes while velocity does: the driver must fill it in"
        if self.wraps:
            return f"position wraps ({self.wraps} times): the driver must let it go on"
        if self.jumps:
            return f"position jumped {self.jumps} times: counter reset, or a second publisher"
        return ""

    def restart(self, sample: WheelSample) -> None:
        """Go on from a sample of another counter, without motion."""
        self.latest, self._doubted = sample, None
        self._past = deque([sample])

    def add(self, sample: WheelSample, max_speed: float) -> bool:
        """Take in a sample; return whether it tells how the wheel turned.

        What needs a wheel faster than ``max_speed`` [rad/s] is a jump.
        """
        last = self.latest
        dt = sample.stamp - last.stamp
        if dt < -CLOCK_JUMP:
            self.restart(sample)
        if dt <= 0.0:
            return False
        guess = sample.velocity * min(dt, LONGEST_GUESS) if math.isfinite(sample.velocity) else 0.0
        moved = sample.position - last.position
        if math.isfinite(moved):
            self._look_for_motion(moved, guess)
        if not math.isfinite(moved) or self._is_unfilled():
            moved = guess
        allowed = max_speed * (dt + JITTER)
        if abs(moved) > allowed:
            unwrapped = moved - math.copysign(TURN, moved)
            if abs(unwrapped) <= allowed and abs(moved) <= TURN + allowed:
                self.wraps += 1
            elif self._is_confirmed(sample, max_speed):
                unwrapped = guess
                self.jumps += 1
            else:
                self._doubted = sample
                return False
            moved = unwrapped
            self._past.clear()
        self._doubted, self.latest = None, sample
        self.angle += moved
        self._past.append(sample)
        return True

    def speed(self, window: float) -> float:
        """Return the mean speed since the last sample that is a window old, or the oldest."""
        past, latest = self._past, self.latest
        while len(past) > 1 and past[1].stamp <= latest.stamp - window:
            past.popleft()
        span, angle = latest.stamp - past[0].stamp, latest.position - past[0].position
        known = span > 0.0 and math.isfinite(angle) and not self._is_unfilled()
        return angle / span if known else latest.velocity

    def forget_speed(self) -> None:
        """Begin the window of the speed anew, as after a silence."""
        self._past = deque([self.latest])

    def _is_unfilled(self) -> bool:
        return self._unmoved is not None and abs(self._unmoved) > UNFILLED

    def _look_for_motion(self, moved: float, guess: float) -> None:
        """Add up what a position that never changed should have moved by."""
        if moved != 0.0:
            self._unmoved = None
        elif self._unmoved is not None:
            before = self._is_unfilled()
            self._unmoved += guess
            if self._is_unfilled() and not before:
                self.angle += self._unmoved - guess  # of this sample the caller adds

    def _is_confirmed(self, sample: WheelSample, max_speed: float) -> bool:
        doubted = self._doubted
        if doubted is None or sample.stamp <= doubted.stamp:
            return False
        allowed = max_speed * (sample.stamp - doubted.stamp + JITTER)
        return abs(sample.position - doubted.position) <= allowed


class _Wheel:
    """What is known of one wheel of a side."""

    def __init__(self) -> None:
        self.travel: WheelTravel | None = None
        self.arrived = -math.inf
        self.heard = False  # since last taken
        self.taken = self.guess = 0.0  # angle when last taken, and with the others of its side

    def angle(self, *, silent: bool) -> float:
        """Return the way since the first sample [rad], guessed while it is silent."""
        return self.guess if silent or self.travel is None else self.travel.angle


class WheelFeedback:
    """What came of each wheel since it was last taken.

    Speeds are averaged over ``window`` [s].
    """

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
        self._totals = [0.0, 0.0]  # of the sides, when last taken

    def receive(
        self, wheel: str, sample: WheelSample, steady_now: float, restarted: bool = False
    ) -> None:
        """Take in a sample; one that is not finite in position and velocity says nothing.

        A publisher that ``restarted`` counts from elsewhere.
        """
        if not (math.isfinite(sample.position) or math.isfinite(sample.velocity)):
            return
        known = self._wheels[wheel]
        if known.travel is None:
            known.travel = WheelTravel(sample, known.guess)
            known.taken, known.arrived = known.guess, steady_now
            return
        if sample.stamp == known.travel.latest.stamp:
            return  # a duplicate is no sign of life
        known.arrived = steady_now
        if restarted:
            known.travel.restart(sample)
        elif known.travel.add(sample, self.max_speed):
            known.heard = True

    def silent(self, steady_now: float, timeout: float) -> dict[str, float]:
        """Return the wheels that have not been heard for too long."""
        ages = {wheel: steady_now - known.arrived for wheel, known in self._wheels.items()}
        return {wheel: age for wheel, age in ages.items() if age > timeout}

    @property
    def latest(self) -> Mapping[str, WheelSample]:
        """The newest sample of every wheel that was ever heard."""
        return {w: k.travel.latest for w, k in self._wheels.items() if k.travel is not None}

    @property
    def problems(self) -> dict[str, str]:
        """What is wrong with the positions of wheels, and what to do about it."""
        told = {w: k.travel.problem for w, k in self._wheels.items() if k.travel is not None}
        return {wheel: problem for wheel, problem in told.items() if problem}

    def take(self, steady_now: float, timeout: float) -> SideTravel | None:
        """Return how far the sides turned since the last time that both told it.

        A wheel that is silent for longer than the time-out is taken to turn as the others of its
        side; what its position tells when it is back makes that good.  While a whole side is
        silent nothing is told, and nothing lost.
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
            _guess(side, living)
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


def _guess(side: Sequence[_Wheel], living: Sequence[_Wheel]) -> None:
    """Let wheels that were not heard since last taken turn as the other ones of their side did."""
    moved = {id(known): known.angle(silent=False) - known.taken for known in living}
    for known in side:
        others = [way for key, way in moved.items() if key != id(known)]
        if known.heard:
            known.guess = known.angle(silent=False)
        elif others:
            known.guess += sum(others) / len(others)
    for known in side:
        known.taken, known.heard = known.angle(silent=False), False
