# SPDX-License-Identifier: Apache-2.0
"""Measure the delay of a loop from the stamp of a sample to the voltage in response.

Commands of ``wheel_pid`` carry the stamp of their sample, so a bag recorded while driving gives the
arrival time of every command.  If the hardware reports the applied voltage, the delay that explains
it best shows whether the driver applies a command on arrival or at its next sample.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.bag import clock, decode, read, source, types
from smp_motor_ident.bag.storage import Table
from smp_motor_ident.errors import BagError

COMMAND = "smp_interfaces/msg/MotorCommand"

MIN_COMMANDS = 50  # smallest number of commands for quantiles of the delay
DELAY_QUANTILE = 0.95
"""Share of the commands that the longest delay covers: a single late command is a disturbance."""

MAX_RESIDUAL_SHARE = 0.3
"""A delay explains the applied voltage if the residual is below this share of its steps."""


@dataclass(frozen=True)
class TransportDelay:
    """Delay from the stamp of a sample to the arrival of its command."""

    usual: float  # median [s]
    longest: float  # 95 % quantile [s]
    latched: bool  # whether the driver keeps a command until its next sample
    answers: int  # number of measured commands

    def until_applied(self, sample_time: float) -> tuple[float, float]:
        """Return usual and longest delay until the voltage is applied."""
        if not self.latched:
            return self.usual, self.longest
        samples = (max(math.ceil(t / sample_time), 1) for t in (self.usual, self.longest))
        usual, longest = (sample_time * n for n in samples)
        return usual, longest


def measure_delay(path: Path) -> dict[str, TransportDelay]:
    """Measure the delay of every wheel's loop with enough commands in a bag."""
    found: dict[str, TransportDelay] = {}
    for recording in source.find_recordings([path]):
        if not recording.is_table:
            found |= _measure_bag(recording)
    if not found:
        raise BagError(
            f"{path}: no wheel with {MIN_COMMANDS} motor_command that answer a motor_state; "
            "record both topics while wheel_pid drives, or give --delay"
        )
    return found


def _measure_bag(recording: source.Recording) -> dict[str, TransportDelay]:
    kinds = {channel.topic: channel.type for channel in recording.channels()}
    pairs = {}
    for topic, kind in kinds.items():
        place = topic.rpartition("/")[0]
        if kind == read.STATE and kinds.get(f"{place}/motor_command") == COMMAND:
            pairs[place.rpartition("/")[2]] = topic, f"{place}/motor_command"
    wanted = {topic: ["voltage"] for pair in pairs.values() for topic in pair}
    tables = decode.collect(recording, wanted, types.Types())
    delays = {w: _measure(tables[state], tables[command]) for w, (state, command) in pairs.items()}
    return {wheel: delay for wheel, delay in delays.items() if delay is not None}


def _measure(state: Table, command: Table) -> TransportDelay | None:
    if state.stamp is None or command.stamp is None or state.stamp.size < MIN_COMMANDS:
        return None
    answers = np.isin(command.stamp, state.stamp)
    if np.count_nonzero(answers) < MIN_COMMANDS:
        return None
    stamp, log = command.stamp[answers], command.logged[answers]
    offset = clock.fit_clock(state.stamp, state.logged)
    # With different clocks, the fastest state defines zero latency.
    one_clock = abs(offset.offset) < clock.MAX_CLOCK_OFFSET_NS
    arrival = 1e-9 * (log - (stamp if one_clock else offset.to_log(stamp)))
    usual, longest = (float(q) for q in np.quantile(arrival, (0.5, DELAY_QUANTILE)))
    period = 1e-9 * float(np.median(np.diff(np.sort(state.stamp))))
    applied = _fit_delay(state, stamp, command.columns["voltage"][answers], period)
    latched = applied is not None and applied > usual + 0.25 * period
    if applied is not None and not latched:
        usual, longest = applied, max(longest, applied)
    return TransportDelay(max(usual, 0.0), max(longest, 0.0), latched, int(stamp.size))


def _fit_delay(state: Table, stamp: Integers, voltage: Array, period: float) -> float | None:
    """Return the delay that explains the reported voltages, or None."""
    assert state.stamp is not None
    order = np.argsort(stamp, kind="stable")
    stamp, voltage = stamp[order], voltage[order]
    time, which = np.unique(state.stamp, return_index=True)
    # Delays of up to three samples, in twentieths of one; what these could reach back to.
    inside = (time > stamp[0] + 4e9 * period) & (time < stamp[-1])
    time, acted = time[inside], state.columns["voltage"][which][inside]
    if time.size < MIN_COMMANDS or not np.all(np.isfinite(acted)):
        return None
    steps = math.sqrt(float(np.mean(np.diff(acted) ** 2)))
    trials = period * np.arange(0, 61) / 20
    left = []
    for trial in trials:
        shifted = stamp + round(1e9 * trial)
        off = (acted - clock.average_held_input(shifted, voltage, "after", time))[1:]
        # Trimmed mean of the errors: ignore late and lost commands.
        left.append(math.sqrt(float(np.mean(np.sort(off**2)[: int(0.9 * off.size)]))))
    best = int(np.argmin(left))
    return float(trials[best]) if left[best] < MAX_RESIDUAL_SHARE * steps else None
