# SPDX-License-Identifier: Apache-2.0
"""Thresholds for wheels on blocks, before and after their excitation."""

from smp_motor_ident.limits import Limit

MIN_FEEDBACK_RATE = Limit(
    40.0,
    "samples per second",
    "a motor of 50 ms is then seen twice in its time constant; below, none of it is left to see",
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
    "where friction takes more, its error and not the motor decides the gain",
    "test_wheel_checks.py: the voltage grows until",
)
MIN_RESPONSE_COUNTS = Limit(
    100.0,
    "counts while a voltage is held",
    "a steady speed that is resolved to one percent",
    "test_wheel_checks.py: the voltage grows until",
)
VELOCITY_TOLERANCE = Limit(
    0.05,
    "of the speed from counts",
    "one encoder tells both, so only rounding may differ; gear ratios on offer differ by more",
    "test_wheel_checks.py: a gear ratio",
)
MAX_GAIN_RATIO = Limit(
    1.5,
    "times the data sheet's",
    "motors of one type differ by a tenth or two; counted edges or gears by a factor of two",
    "test_wheel_checks.py: a gear ratio",
)
MAX_DEAD_ZONE_SHARE = Limit(
    0.05,
    "of the supply",
    "what feed-forward cannot know must be filled by the integral; a twentieth takes it one "
    "transition",
    "test_wheel_checks.py: a dead zone",
)
MAX_SUPPLY_SHORTFALL = Limit(
    0.1,
    "of the commanded voltage",
    "cost: the loop is slower, and its feed-forward short, by as much; batteries in order sag less",
    "test_wheel_checks.py: a weak battery",
)
MAX_FRICTION_RATIO = Limit(
    3.0,
    "times the median of the other wheels",
    "frictions of one type of motor scatter by a half; three times is a brake",
    "test_wheel_checks.py: a wheel that drags",
)
MAX_SPEED_RATIO = Limit(
    1.5,
    "times the speed that the checks predict at the largest voltage",
    "a supply that is too high adds a tenth, lost friction another; only a broken encoder, another "
    "driver or another motor makes half",
    "test_commission_plan.py: a wheel that turns faster than its checks",
)
MAX_RESISTANCE_RISE = Limit(
    0.2,
    "of the resistance in an earlier signal",
    "51 K of copper above a room's 25 leave a margin to the 105 of insulation class A",
    "test_winding.py: a winding that heats",
)
REQUIRED_ACCURACY = Limit(
    0.01,
    "relative standard deviation",
    "cost: a loop that is off by a hundredth in gain or time constant; margins bear twenty times "
    "that, and a further recording takes a minute",
    "test_commission_plan.py: a motor that is not known well enough",
)
VALIDATION_LEVEL = Limit(
    0.01,
    "significance level",
    "one sound wheel in a hundred may be said to be worse on data that no fit has seen",
    "test_validation_run.py: a motor that did not change",
)
VALIDATION_TOLERANCE = Limit(
    0.05,
    "of the speed's scatter",
    "cost: margins bear a gain that is off by more; a twentieth that is unexplained moves none",
    "test_validation_run.py: a motor that changed",
)
