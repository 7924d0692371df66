# SPDX-License-Identifier: Apache-2.0
"""Drivers: ways in which the voltage at the terminals is not the command."""

from __future__ import annotations

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident._compile import compiled
from smp_motor_ident.chain.component import Component, Parameter, Scales, Values
from smp_motor_ident.simulate import lanes as at
from smp_motor_ident.simulate.rows import Rows


class DeadZone(Component):
    """A driver that subtracts a voltage from the size of a command [V]."""

    code, slot, title = "dead_zone", "dead_zone", "dead zone of the driver"
    severity = "warning"
    advice = "set the dead zone of the driver or firmware to zero, or compensate it in the command"
    linear = "dead_zone"
    parameters = (Parameter("dead_zone", "V", 0.0, 0.6, typical=0.03),)
    guesses = (0.02, 0.1)

    def shape_command(self, p: Values, command: Array, rows: Rows, scales: Scales) -> Array:
        """Return the command less the dead zone."""
        return command - np.clip(command, -p["dead_zone"], p["dead_zone"])


class HardDeadZone(Component):
    """A driver that ignores commands below a size [V] and applies larger ones in full."""

    code, slot, title = "hard_dead_zone", "dead_zone", "driver that ignores small commands"
    severity = "warning"
    advice = "lower the least command of the firmware, or keep commands above it"
    parameters = (Parameter("least_command", "V", 0.0, 0.6, typical=0.1, threshold=True),)
    guesses = tuple(0.03 * k for k in range(1, 17))  # every level of a command falls between two
    EDGE_SHARE = 0.02
    """Share of the largest command over which it sets in, so that it has a derivative."""

    def shape_command(self, p: Values, command: Array, rows: Rows, scales: Scales) -> Array:
        """Return the command where it is large enough."""
        beyond = (np.abs(command) - p["least_command"]) / (self.EDGE_SHARE * scales.volts)
        return command * np.clip(beyond + 0.5, 0.0, 1.0)


class Clip(Component):
    """A supply that limits the voltage [V]."""

    code, slot, title = "clip", "clip", "command clipped at the supply"
    severity = "warning"
    advice = "keep commands below the supply, or record the voltage at the terminals"
    rank = 2
    linear = "clip_voltage"
    needs_own_start = True
    parameters = (Parameter("clip_voltage", "V", 0.05, 1.0, neutral=1.0, typical=0.1),)
    guesses = (0.95, 0.85, 0.7, 0.5)

    def shape_command(self, p: Values, command: Array, rows: Rows, scales: Scales) -> Array:
        """Return the command within the limit."""
        return np.clip(command, -p["clip_voltage"], p["clip_voltage"])


class WeakSide(Component):
    """A driver that puts out a smaller share of commands in reverse."""

    code, slot, title = "weak_side", "weak_side", "driver weaker in reverse"
    severity = "warning"
    advice = "record the voltage at the terminals, which separates driver and motor"
    rank = 1
    linear = "weak_side"
    parameters = (Parameter("weak_side", "1", -0.5, 0.5, typical=0.02),)
    guesses = (0.03,)

    def shape_command(self, p: Values, command: Array, rows: Rows, scales: Scales) -> Array:
        """Return the command, in reverse reduced."""
        return np.asarray(command * (1 - np.where(command < 0, p["weak_side"], 0.0)))


class Slew(Component):
    """A driver that limits how fast its voltage changes: seconds for a largest command [s]."""

    code, slot, title = "slew", "slew", "driver with a slew limit"
    severity = "warning"
    advice = "raise or switch off the ramp of the driver"
    rank = 3
    linear = "ramp_time"
    needs_own_start = True
    lag, lateness = "ramp_time", 0.5
    parameters = (Parameter("ramp_time", "s", 0.0, 20.0, typical=0.3),)
    guesses = (0.2, 0.6, 1.5, 4.0)

    def shape_command(self, p: Values, command: Array, rows: Rows, scales: Scales) -> Array:
        """Return the mean voltage of every section, behind the limit."""
        ends = np.append(rows.begin[1:], rows.time[-1])
        last = rows.section[1:] - 1
        ends[last] = rows.time[rows.segment[1:] - 1]
        begin = rows.begin.copy()
        begin[rows.section[:-1]] = rows.time[rows.segment[:-1]]
        length = np.maximum(ends - begin, 0.0)
        rate = scales.volts / np.maximum(p["ramp_time"], 1e-12)
        shaped = np.broadcast_to(command, (command.shape[0], rate.size))
        return _limit_slew(np.ascontiguousarray(shaped), length, rows.section, rate)


class Sag(Component):
    """A supply with a resistance of its own, over that of the armature."""

    code, slot, title = "supply_sag", "sag", "supply that sags under load"
    severity = "warning"
    advice = "record the supply voltage, or use a battery of lower resistance"
    linear = "source_resistance_ratio"
    parameters = (Parameter("source_resistance_ratio", "1", 0.0, 5.0, typical=0.05),)
    guesses = (0.05, 0.3)
    places = (at.SAG,)


class Drop(Component):
    """A constant voltage drop over brushes or transistors [V]."""

    code, slot, title = "brush_drop", "drop", "voltage drop over brushes or transistors"
    advice = "record the voltage at the terminals so that the estimates exclude the driver"
    linear = "brush_drop"
    parameters = (Parameter("brush_drop", "V", 0.0, 0.4, typical=0.03),)
    guesses = (0.02, 0.1)
    places = (at.DROP,)


class CurrentLimit(Component):
    """A driver that limits the current: the limit times the resistance [V]."""

    code, slot, title = "current_limit", "current_limit", "driver that limits the current"
    severity = "warning"
    advice = "raise the current limit of the driver, or excite with smaller steps"
    linear = "current_limit_voltage"
    needs_own_start = True
    parameters = (Parameter("current_limit_voltage", "V", 0.02, 2.0, neutral=2.0, typical=0.5),)
    guesses = (1.5, 0.8, 0.4)  # of reversals, then such as steps reach
    places = (at.CURRENT_LIMIT,)


class FastDecay(Component):
    """A bridge that is off for the rest of each PWM period: L/R in periods."""

    code, slot, title = "coast", "decay", "driver that lets the motor coast (fast decay)"
    severity = "warning"
    advice = (
        "let the driver brake between its pulses (slow decay), or record the voltage at the "
        "terminals"
    )
    needs_own_start = True
    parameters = (Parameter("fast_decay_ratio", "1", 0.02, 300.0),)
    guesses = (0.1, 0.5, 2.0, 10.0)
    places = (at.DECAY,)


class FreeAtZero(Component):
    """A bridge that is open while the command is zero: share of the back-EMF at the terminals."""

    code, slot, title = "coast_at_zero", "free", "driver that lets the motor coast at zero"
    advice = "let the driver brake at zero command"
    linear = "coasting_share"
    parameters = (Parameter("coasting_share", "1", 0.0, 1.0, typical=0.1),)
    guesses = (0.9,)
    places = (at.FREE,)


class Decline(Component):
    """A battery whose voltage falls by a share over the recording."""

    code, slot, title = "supply_drift", "decline", "battery that declines"
    severity = "warning"
    advice = "charge the battery, or record the supply voltage"
    linear = "decline"
    parameters = (Parameter("decline", "1", -0.5, 0.8, typical=0.02),)
    guesses = (0.03,)
    places = (at.DECLINE,)


@compiled
def _limit_slew(command: Array, length: Array, section: Integers, rate: Array) -> Array:
    out = np.empty(command.shape)
    for g in range(section.shape[0] - 1):
        for b in range(command.shape[1]):
            now = command[section[g], b]
            for k in range(section[g], section[g + 1]):
                step, most = command[k, b] - now, rate[b] * length[k]
                if abs(step) <= most or most <= 0.0:
                    # The ramp ends inside: a triangle is missing from the mean.
                    missing = 0.5 * step * abs(step) / rate[b] / length[k] if length[k] > 0 else 0.0
                    out[k, b] = command[k, b] - missing
                    now = command[k, b] if length[k] > 0.0 else now
                else:
                    end = now + (most if step > 0 else -most)
                    out[k, b] = 0.5 * (now + end)
                    now = end
    return out
