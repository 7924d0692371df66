# SPDX-License-Identifier: Apache-2.0
"""Every threshold of a decision about recordings, with its unit and its reason."""

from smp_motor_ident.limits import Limit

MIN_UNPACKED_LIMIT = Limit(
    256e6,
    "byte",
    "cost: memory that any machine with ROS can spare; every file may unpack to this size",
    "test_bounds.py",
)
MAX_UNPACKING_RATIO = Limit(
    50.0,
    "1",
    "cost: 1 GB for a file of 10 MB, half of it unpacked bytes; telemetry is packed 3 to 20 times",
    "test_bounds.py",
)
MAX_COLUMNS = Limit(
    16_384,
    "1",
    "cost: columns or topics of a recording; Excel has no more columns, and robots have fewer "
    "topics",
    "test_hostile.py",
)
MAX_DEFINITION_SIZE = Limit(
    500_000,
    "byte",
    "cost: parsing one definition of a message type takes 1.5 s; all of a recording may have six "
    "times this size; real ones, with comments and nested types, have up to 150 kB",
    "test_hostile.py",
)
MAX_STRAY_ROW_SHARE = Limit(
    0.05,
    "1",
    "cost: an estimate without one row in twenty keeps its value; more point to another format",
    "test_csv.py",
)
MAX_JUMP_SPAN = Limit(
    20.0,
    "1",
    "physical: no real signal jumps for single samples beyond twenty times the range of 98 % of "
    "its "
    "values",
    "test_checks.py",
)
MAX_JUMP_STEP = Limit(
    20.0,
    "1",
    "physical: inertia excludes steps there and back of twenty times the 99 % quantile of the "
    "steps",
    "test_checks.py",
)
UNSIGNED_CURRENT_RATIO = Limit(
    2.0,
    "1",
    "physical: the mean armature currents of both directions cancel except for an offset; those of "
    "an unsigned current add up",
    "test_checks.py",
)
MAX_LATE_COMMAND_RESIDUAL = Limit(
    0.1,
    "1",
    "cost: share of the motion that a first-order lag leaves unexplained after the shift; with "
    "more, "
    "another fault is likelier than a late command",
    "test_late_voltage.py",
)
MAX_SHIFTED_RESIDUAL_RATIO = Limit(
    0.6,
    "1",
    "cost: the shift must reduce the residual by two fifths; friction and a winding leave the same "
    "residual at every shift",
    "test_late_voltage.py",
)
EXPLANATION_LEVEL = Limit(
    1e-6,
    "1",
    "significance: with a thousand pairs of fields tried, one in a thousand listings is wrong",
    "test_propose.py",
)
MIN_RESTART_ROWS = Limit(
    5.0,
    "sample",
    "physical: jitter moves a row by fewer intervals; a restarted clock goes back by more, and at "
    "least as many rows follow",
    "test_runs.py",
)
MIN_CLOCK_LEAP_S = Limit(
    86_400.0,
    "s",
    "physical: no run pauses for a day; after a clock was set, or on another day, the length of "
    "the "
    "pause is unknown",
    "test_timing.py",
)
MAX_WIDTH_ERROR = Limit(
    2e-3,
    "1",
    "physical: an error of the width is an error of the gain, and gains are stated to a few parts "
    "in a thousand; a less certain width must be given",
    "test_counter.py",
)
MIN_SATURATED_SHARE = Limit(
    0.02,
    "1",
    "physical: a wrapping counter has its last value for one sample, a full one as long as the "
    "motor turns",
    "test_counter.py",
)
MIN_ALIASED_STEPS = Limit(
    3.0,
    "1",
    "physical: no motor reverses at full speed within a sample; a fault may imitate this once or "
    "twice",
    "test_counter.py",
)
MIN_ALIASED_STEP_SHARE = Limit(
    0.46,
    "1",
    "cost: step per sample as a share of a turn; below it a motor may reverse within one sample",
    "test_counter.py",
)
MAX_COUNT_STEP = Limit(
    2.0**32,
    "count",
    "physical: an encoder of a million counts at 100,000 rpm makes half of it in a second",
    "test_counter.py",
)
MIN_COUNTS_BETWEEN_PUBLISHERS = Limit(
    1000.0,
    "count",
    "physical: no wheel turns so far forth and back from sample to sample; two publishers of one "
    "topic, each with its own count, seem to",
    "test_checks.py",
)
MIN_RETURNING_SHARE = Limit(
    0.25,
    "1",
    "physical: of two publishers, one of which may send twice as often, a third of the samples "
    "lies between two of the other",
    "test_checks.py",
)
MAX_ROW_INTERVAL_S = Limit(
    10.0,
    "s",
    "physical: no motor of a robot changes its speed so slowly; such rows are in milliseconds or "
    "microseconds",
    "test_csv.py",
)
