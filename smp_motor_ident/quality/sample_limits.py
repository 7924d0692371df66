# SPDX-License-Identifier: Apache-2.0
"""Thresholds for single samples: instants, readings, and the driver between them."""

from smp_motor_ident.limits import Limit

# Stamps of arrival, fitted to the sender's period.
BEAT_FLOOR = Limit(0.5, "sample", "physical: later than half a sample is the next", "test_beat.py")
BEAT_JITTER = Limit(
    0.02, "sample", "cost: smaller errors of instants are below their rounding", "test_beat.py"
)
BEAT_LOST = Limit(0.02, "1", "cost: with more lost a sample's number is a guess", "test_beat.py")
SMOOTHER = Limit(
    3.1, "standard deviations", "sign test of size 1e-3, else stamps are kept", "test_beat.py"
)

# Readings that do not show the motor.
GLITCH = Limit(
    10.0, "upper quartiles of a reading's jump beyond both neighbours",
    "nine deviations of white noise: chance reaches them in no record",
    "test_glitches.py: noise and fast motion are not glitches",
)  # fmt: skip
GLITCHES = Limit(
    0.05, "of the readings",
    "cost: a sensor that is wrong more often is to be mended, not corrected",
    "test_glitches.py: a sensor that is wrong too often is left as it is",
)  # fmt: skip
REGULATED = Limit(
    0.98, "of the variance",
    "physical: at one current the voltage is a line of the speed but for a voltmeter's scatter; "
    "behind a sensor's limit the current goes on, and takes its share of the voltage",
    "test_saturation.py: a regulated current is not clipped",
)  # fmt: skip
NOMINAL_PERIOD = Limit(
    0.5, "slope",
    "cost: half-way between a motor's speed (0) and counts over a constant nominal period (1), "
    "whose gain has the relative error of the intervals",
    "test_differenced.py: counts over a nominal period are a speed over the real intervals",
)  # fmt: skip
EDGES = Limit(
    12, "readings",
    "cost: fewer matching holding times occur by chance",
    "test_edge_timer.py: a rounded or held speed from counts is not edge timed",
)  # fmt: skip
HELD = Limit(
    0.85, "of the slow readings",
    "cost: intervals after reversals and rests do not match a count; those of other sensors match "
    "in a third of the cases at most",
    "test_edge_timer.py: a rounded or held speed from counts is not edge timed",
)  # fmt: skip

EDGE_SPEED = Limit(
    1e-3, "of the largest speed",
    "cost: the lag of smaller readings has no effect on the estimates; the tail of a filter "
    "has any number of small readings",
    "test_edge_timer.py: the tail of a filter is not edge timed",
)  # fmt: skip
COUNTS_A_SAMPLE = Limit(
    2.0, "counts",
    "cost: up to this many, differences of counts are summed for any motion; with more they serve "
    "as speeds, and are summed only if the fit's residual is one count's rounding",
    "test_differenced.py: counts are detected in the speed of an unmodelled motor",
)  # fmt: skip

# Physical limits of motors, which show wrong units.
HIGHEST_SPEED = Limit(
    8400.0, "rad/s",
    "physical: 80,000 rpm, the limit of brushes and bearings of the smallest coreless motors",
    "test_poor_records.py: a speed in rpm or a command in amperes makes a motor that hardly is",
)  # fmt: skip
FAST_MOTOR = Limit(
    4200.0, "rad/s",
    "physical: 40,000 rpm; motors of small geared drives end at 33,000 (N20), catalogues of "
    "coreless ones at 20,000; beyond are the motors of toys",
    "test_poor_records.py: a speed in rpm or a command in amperes makes a motor that hardly is",
)  # fmt: skip
FRICTION_MOST = Limit(
    0.5, "of the largest voltage",
    "physical: geared motors start at a tenth to a third of their largest voltage; where friction "
    "takes more than half of it, the estimates depend on the law of friction, or on a driver that "
    "coasts between its pulses",
    "test_limits_hold.py: a motor that friction nearly holds is unreliable",
)  # fmt: skip
LEFT_BY_SILENCE = Limit(
    0.5, "share of a record",
    "an encoder that is silent in most of a record must be repaired",
    "test_silence.py: a motor that is blocked for a while is estimated from the rest",
)  # fmt: skip

# Rows of a long recording that are used.
EXCERPT = Limit(
    200_000, "rows",
    "cost: a minute of processor for ten million rows; that many tell the numbers more narrowly "
    "than the instruments are known",
    "test_excerpts.py: the stretches of a long record tell its motor",
)  # fmt: skip
