"""The regression of a model's error on effects that the model lacks, and its sums over blocks."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.diagnosis.effects import Effect


@dataclass(frozen=True, eq=False)
class Regression:
    """Residuals and regressors of one fit, the model's own coordinates projected out."""

    residual: Array  # shape (n,): of unit variance; the current's after the output's
    # shape (n, r): responses to effects, the model's own coordinates projected out
    regressors: Array
    whole: Array  # shape (n, r): the same as they are
    shifts: Array  # shape (f, r): change of the free coordinates for a unit of each
    block: Integers  # shape (n,): which stretch of time a row belongs to
    members: Sequence[tuple[Effect, tuple[int, ...]]]  # which columns are whose
    own: Array  # shape (n, p): sensitivities to the free coordinates and initial states
    n_free: int
    # shape (n,) each: -1 in one half of the motion, 1 in the other
    conditions: dict[str, Array] = field(default_factory=dict)
    # effects that the model's own coordinates imitate: column, and size that is ordinary
    hidden: Sequence[tuple[Effect, int, float]] = ()
    changing: bool = False  # whether each segment has coordinates of its own

    @cached_property
    def normal(self) -> Array:
        """Products of the regressors, shape (r, r)."""
        return np.asarray(self.regressors.T @ self.regressors)

    @cached_property
    def moved(self) -> Array:
        """Products of regressors and residual, shape (r,)."""
        return np.asarray(self.regressors.T @ self.residual)

    @cached_property
    def known(self) -> Array:
        """1 for rows with a measurement, 0 for others: their residual is zero."""
        return np.asarray(self.residual != 0.0, dtype=np.float64)

    @cached_property
    def weights(self) -> Array:
        """What each block has of the regressors' squares, of the most of any; shape (b, r)."""
        squares = self.by_block(np.square(self.regressors))
        return np.asarray(squares / np.maximum(squares.max(axis=0), 1e-300))

    def by_block(self, columns: Array) -> Array:
        """Return the sums of columns, shape (n, c), over the rows of each block, shape (b, c)."""
        begins = self._runs
        sums: Array = np.zeros((int(self.block.max()) + 1, columns.shape[1]))
        np.add.at(sums, self.block[begins], np.add.reduceat(columns, begins))
        return sums

    @cached_property
    def _runs(self) -> Integers:
        """Where runs of rows of one block begin."""
        return np.flatnonzero(np.diff(self.block, prepend=-1))
