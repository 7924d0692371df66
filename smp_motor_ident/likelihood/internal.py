"""Names for the entries of what the compiled loops share."""

from __future__ import annotations

# Entries of the internal parameter vector `par` (and rows of its derivative `slope`).
TE, TM, K, BE, VC_PLUS, VC_MINUS, LOAD, R, CURRENT_OFFSET, DELAY, WINDOW = range(11)
# What the mechanical output is.
SPEED, ANGLE, MEAN_SPEED = 0, 1, 2
# Direction of motion of a motor at rest.
STUCK = 0.0
