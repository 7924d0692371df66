# SPDX-License-Identifier: Apache-2.0
"""Thresholds for wheels on blocks, before and after their excitation."""

from smp_motor_ident.limits import Limit

MIN_FEEDBACK_RATE = Limit(
    40.0,
    "samples per second",
    "a motor with a time constant of 50 ms is then sampled twice within it; slower samples hide it",
    "test_wheel_checks.py: feedback that comes too seldom",
)
MAX_FEEDBACK_AGE = Limit(
    0.2,
    "s on arrival",
    "wheel_pid treats older feedback as lost and stops the wheel",
    "test_wheel_checks.py: feedback that comes too seldom",
)
BREAKAWAY_COUNTS = Limit(
    10.0,
    "counts in one direction",
    "an encoder at rest on an edge toggles by a count or two; ten counts are a rotation",
    "test_wheel_checks.py: a trembling encoder",
)
MAX_FRICTION_SHARE = Limit(
    0.1,
    "of the voltage",
    "with more friction, its error dominates the estimated gain",
    "test_wheel_checks.py: the voltage grows until",
)
MIN_RESPONSE_COUNTS = Limit(
    100.0,
    "counts while a voltage is held",
    "they resolve a steady speed to one percent",
    "test_wheel_checks.py: the voltage grows until",
)
VELOCITY_TOLERANCE = Limit(
    0.05,
    "of the speed from counts",
    "both come from one encoder, so they differ by rounding only; available gear ratios differ by "
    "more",
    "test_wheel_checks.py: a gear ratio",
)
MAX_GAIN_RATIO = Limit(
    1.5,
    "times the data sheet's",
    "motors of one type differ by up to 20 %; a wrong count of edges or gear makes a factor of two",
    "test_wheel_checks.py: a gear ratio",
)
MAX_DEAD_ZONE_SHARE = Limit(
    0.05,
    "of the supply",
    "the integral must compensate what the feed-forward does not know; for a twentieth it needs "
    "one "
    "transition",
    "test_wheel_checks.py: a dead zone",
)
MAX_SUPPLY_SHORTFALL = Limit(
    0.1,
    "of the commanded voltage",
    "cost: loop and feed-forward lose the same share; sound batteries sag less",
    "test_wheel_checks.py: a weak battery",
)
MAX_FRICTION_RATIO = Limit(
    3.0,
    "times the median of the other wheels",
    "the friction of motors of one type scatters by a half; three times as much is a fault",
    "test_wheel_checks.py: a wheel that drags",
)
MAX_SPEED_RATIO = Limit(
    1.5,
    "times the speed that the checks predict at the largest voltage",
    "a high supply adds a tenth, less friction another; half more means a broken encoder, another "
    "driver or another motor",
    "test_commission_plan.py: a wheel that turns faster than its checks",
)
MAX_RESISTANCE_RISE = Limit(
    0.2,
    "of the resistance in an earlier signal",
    "copper 51 K above 25 °C keeps a margin to the 105 °C of insulation class A",
    "test_winding.py: a winding that heats",
)
REQUIRED_ACCURACY = Limit(
    0.01,
    "relative standard deviation",
    "cost: margins tolerate twenty times this error of gain or time constant, and a further "
    "recording takes a minute",
    "test_commission_plan.py: a motor that is not known well enough",
)
VALIDATION_LEVEL = Limit(
    0.01,
    "significance level",
    "one sound wheel in a hundred may be rejected on held-out data",
    "test_validation_run.py: a motor that did not change",
)
VALIDATION_TOLERANCE = Limit(
    0.05,
    "of the speed's scatter",
    "cost: margins tolerate a larger error of the gain; a smaller unexplained share affects none",
    "test_validation_run.py: a motor that changed",
)
