# SPDX-License-Identifier: Apache-2.0
"""Every threshold of a decision about recordings, with its unit and its reason.

Printed with the others in ``docs/limits.md``.
"""

from smp_motor_ident.limits import Limit

MIN_UNPACKED_LIMIT = Limit(
    256e6,
    "byte",
    "cost: what any machine that runs ROS can spare; a smaller file may always unpack to it",
    "test_bounds.py",
)
MAX_UNPACKING_RATIO = Limit(
    50.0,
    "1",
    "cost: 1 GB at most for a file of 10 MB, half of it unpacked bytes; telemetry packs 3 to 20",
    "test_bounds.py",
)
MAX_COLUMNS = Limit(
    16_384,
    "1",
    "cost: columns or topics that are looked at; no spreadsheet has more, and no robot",
    "test_hostile.py",
)
MAX_DEFINITION_SIZE = Limit(
    500_000,
    "byte",
    "cost: 1.5 s for one definition of a message type, six times as much for all of a recording; "
    "with all that they refer to and their comments real ones have up to 150 kB",
    "test_hostile.py",
)
MAX_STRAY_ROW_SHARE = Limit(
    0.05,
    "1",
    "cost: an estimate without one row in twenty keeps its value; with more it is no table",
    "test_csv.py",
)
MAX_JUMP_SPAN = Limit(
    20.0,
    "1",
    "physical: no signal leaves twenty times the range of 98 % of its values for single samples",
    "test_checks.py",
)
MAX_JUMP_STEP = Limit(
    20.0,
    "1",
    "physical: inertia forbids steps to and fro of twenty times the 99 % quantile of the steps",
    "test_checks.py",
)
UNSIGNED_CURRENT_RATIO = Limit(
    2.0,
    "1",
    "physical: an armature's means in both directions cancel but for an offset; a size's add up",
    "test_checks.py",
)
MAX_LATE_COMMAND_RESIDUAL = Limit(
    0.1,
    "1",
    "cost: a command is moved only where a first-order lag then explains nine tenths of the "
    "motion; where less is explained something else is wrong",
    "test_late_voltage.py",
)
MAX_SHIFTED_RESIDUAL_RATIO = Limit(
    0.6,
    "1",
    "cost: the residual without a shift must shrink by two fifths; with friction and a winding it "
    "is the same at every shift",
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
    "physical: jitter moves a row by less than as many intervals; a clock that starts again goes "
    "back by more, and as many rows go on from there",
    "test_runs.py",
)
MIN_CLOCK_LEAP_S = Limit(
    86_400.0,
    "s",
    "physical: no run pauses for a day; a clock that was set, or another day's run, does not tell "
    "how long nothing was recorded",
    "test_timing.py",
)
MAX_WIDTH_ERROR = Limit(
    2e-3,
    "1",
    "physical: a width's error is that of the gain, and gains are stated to a few parts in a "
    "thousand; a width that is less sure must be given",
    "test_counter.py",
)
MIN_SATURATED_SHARE = Limit(
    0.02,
    "1",
    "physical: a counter that turns stands at the last number of its width for a sample, a full "
    "one as long as the motor turns on",
    "test_counter.py",
)
MIN_ALIASED_STEPS = Limit(
    3.0,
    "1",
    "physical: no motor reverses at full speed from one sample to the next; a fault may look "
    "so once or twice",
    "test_counter.py",
)
MIN_ALIASED_STEP_SHARE = Limit(
    0.46,
    "1",
    "cost: of a turn from sample to sample; a motor that stays below may reverse in one sample",
    "test_counter.py",
)
MAX_COUNT_STEP = Limit(
    2.0**32,
    "count",
    "physical: a million counts a turn at 100,000 rpm are half of it in a second",
    "test_counter.py",
)
MAX_ROW_INTERVAL_S = Limit(
    10.0,
    "s",
    "physical: no motor of a robot takes so long for a change of its speed; rows that are so far "
    "apart are of milliseconds or microseconds",
    "test_csv.py",
)
