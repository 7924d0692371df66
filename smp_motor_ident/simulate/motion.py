# SPDX-License-Identifier: Apache-2.0
"""Simulate the motion of a motor for several sets of parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.simulate import lanes as at
from smp_motor_ident.simulate.kernel import simulate_rows, transitions
from smp_motor_ident.simulate.rows import Pieces, Rows

FEEDBACK_PARAMETERS = [
    at.SAG, at.DROP, at.CURRENT_LIMIT, at.DECAY, at.FREE, at.DECLINE, at.DRAG, at.STRIBECK,
    at.FRICTION_DRIFT, at.LOAD_STEP,
]  # fmt: skip
"""Parameters for which the voltage or a force follows the motion."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a motor at every row, for every lane: arrays of shape (n, lanes)."""

    drive: Array  # q = R i [V]
    speed: Array  # [rad/s]
    angle: Array  # [rad]
    charge: Array  # integral of q [V s], shape (0, lanes) where it was not asked for
    command: Array  # [V], shape (sections, lanes) or (sections, 1)
    pieces: Pieces
    full_duty: float  # [V]

    @property
    def duty(self) -> Array:
        """Voltage of the row over full duty, shape (n, 1)."""
        last = np.maximum(self.pieces.first[1:] - 1, 0)
        return self.command[self.pieces.section[last], :1] / self.full_duty


def follows_motion(lanes: Array) -> bool:
    """Tell whether any lane's voltage or force follows the motion."""
    neutral = at.NEUTRAL[FEEDBACK_PARAMETERS, None]
    return bool((lanes[FEEDBACK_PARAMETERS] != neutral).any())


def simulate(
    rows: Rows,
    pieces: Pieces,
    lanes: Array,
    command: Array,
    initial: Array,
    own: Array | None = None,
    shift: Array | None = None,
    full_duty: float = 1.0,
    charge: bool = False,
) -> Motion:
    """Simulate all lanes on all rows.

    Parameters
    ----------
    rows, pieces : Rows, Pieces
        Where the outputs are wanted, and where the command switches.
    lanes : ndarray, shape (parameters, lanes)
        Parameters, in the order of `simulate.lanes`.
    command : ndarray, shape (sections, lanes) or (sections, 1)
        Voltage [V] of every section.
    initial : ndarray, shape (segments, 4)
        q [V], speed, angle and load [V] at the beginning of every segment.
    own : ndarray, shape (4, lanes), optional
        Added by a lane to every segment's initial state.
    shift : ndarray, shape (lanes,), optional
        Additional delay [s] of a lane's command relative to the pieces; never negative.
    full_duty : float
        Command [V] at which the driver is always on.
    charge : bool
        Whether the integral of the current is wanted.

    Returns
    -------
    Motion
        Of shape (n, lanes) each.
    """
    count = lanes.shape[1]
    moved = np.zeros(count) if shift is None else shift
    added = np.zeros((4, count)) if own is None else own
    lengths = np.maximum(pieces.grouped[:, None] + pieces.grouped_edges[:, None] * moved, 0.0)
    tables = transitions(lengths, lanes)
    feedback = follows_motion(lanes)
    halves = transitions(0.5 * lengths, lanes) if feedback else tables
    friction = bool((lanes[[at.VC_PLUS, at.VC_MINUS]] != 0).any())
    age: Array = np.zeros(0)
    if (lanes[[at.DECLINE, at.FRICTION_DRIFT, at.LOAD_STEP]] != 0).any():
        age = rows.age[pieces.row]
    out = np.empty((3, count, len(rows)))
    volts = np.zeros((count, len(rows) if charge else 0))
    simulate_rows(
        pieces.first, pieces.row, pieces.length, pieces.edges, pieces.group, pieces.section,
        np.ascontiguousarray(command.T), tables, halves, np.ascontiguousarray(lanes), moved,
        rows.segment, initial, added, friction, feedback, full_duty, age, out, volts,
    )  # fmt: skip
    drive, speed, angle = out
    gathered: Array = volts
    if charge:
        first = np.repeat(rows.segment[:-1], np.diff(rows.segment))
        put = np.cumsum(volts, axis=1)
        gathered = put - put[:, first] - lanes[at.TE, :, None] * (drive - drive[:, first])
        gathered -= lanes[at.K, :, None] * (angle - angle[:, first])
    return Motion(drive.T, speed.T, angle.T, gathered.T, command, pieces, full_duty)
