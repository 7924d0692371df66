"""Every threshold of a decision about data and estimates, with its unit and its reason.

``docs/limits.md`` is this table, printed: ``python scripts/limits.py > docs/limits.md``.
A limit's reason is a significance level, a cost or a physical limit; that some record came out
right is none.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """One threshold: its value and unit, why it is what it is, and the test that shows it."""

    value: float
    unit: str
    reason: str
    test: str


# Reading recordings (smp_motor_ident.bag).
UNPACKED_LEAST = Limit(
    256e6,
    "byte",
    "cost: what any machine that runs ROS can spare; a smaller file may always unpack to it",
    "test/ident/bag/test_bounds.py",
)
UNPACKED_RATIO = Limit(
    50.0,
    "1",
    "cost: 1 GB at most for a file of 10 MB, half of it unpacked bytes; telemetry packs 3 to 20",
    "test/ident/bag/test_bounds.py",
)
STRAY_ROWS = Limit(
    0.05,
    "1",
    "cost: an estimate without one row in twenty keeps its value; with more it is no table",
    "test/ident/bag/test_csv.py",
)

# Assessment of a fit.

FIT_EXPLAINS = Limit(
    70.0,
    "% of the speed",
    "below it a third of the motion comes from elsewhere; no interval of a "
    "model that lacks a third of what happens means anything",
    "test_findings.py",
)
FIT_HOLDS = Limit(
    15.0,
    "% of the speed",
    "held-out data that are fitted so much worse are of another motor or "
    "load; chance alone changes a fit by parts of a percent",
    "test_findings.py",
)
FIT_INDEPENDENT = Limit(
    95.0,
    "% of the speed",
    "what follows the voltage in the last twentieth of the motion changes "
    "the gain by less than that",
    "test_findings.py",
)
UNEXPLAINED = Limit(
    9.0,
    "ratio of variances",
    "an encoder's rounding has a variance of a twelfth of a count; three "
    "times its deviation is beyond any counter",
    "test_findings.py",
)
RINGING = Limit(
    1.5,
    "rad per sample",
    "at pi a ringing cannot be told from a slower one; at half of that "
    "sampling between two swings still shows both",
    "test_findings.py",
)
SETTLED = Limit(
    0.5,
    "standard deviations",
    "a further step of this size changes an interval's coverage by less than 5 %",
    "test_findings.py",
)
STEADY = Limit(
    4.0,
    "time constants",
    "98 % of a step are over",
    "test_estimate.py",
)
SQUARE_LEVEL = Limit(
    0.03,
    "share of the level",
    "what a voltmeter scatters around a level",
    "test_estimate.py",
)
FRICTION_SHOWN = Limit(
    0.5,
    "relative standard deviation",
    "beyond it zero lies inside the 95 % interval",
    "test_findings.py",
)
FEWEST = Limit(
    40,
    "samples",
    "ten for each of gain, lag, friction and initial state",
    "test_screening.py",
)
MOST_LOST = Limit(
    0.3,
    "share of the samples",
    "beyond it the sensor, not the transport, is at fault",
    "test_screening.py",
)
METER = Limit(
    0.01,
    "share of the supply or of a level",
    "what a voltmeter scatters",
    "test_screening.py",
)
OFFSET_SURE = Limit(
    6.0,
    "standard deviations",
    "of an offset of the current, with errors of neighbouring runs that "
    "hang together allowed for; chance exceeds it once in 5e8",
    "test_screening.py",
)
LARGEST_OFFSET = Limit(
    0.2,
    "share of the largest current",
    "a sensor so far from its zero is not calibrated",
    "test_screening.py",
)
RESIDUAL_LEVEL = Limit(
    0.05,
    "probability",
    "that any of the lags of clean residuals leaves its band",
    "test_findings.py",
)

# Adequacy of the model.

EFFECT_LEVEL = Limit(
    0.01,
    "probability",
    "that a clean record shows any of the effects, shared among all that are tried (Bonferroni)",
    "test_adequacy.py",
)
EFFECT_BLOCKS = Limit(
    6,
    "degrees of freedom",
    "with fewer stretches of data that show an effect its covariance, and "
    "so the test's level, is not known",
    "test_adequacy.py",
)
EFFECT_OWN = Limit(
    1e-6,
    "share of the sum of squares",
    "an effect that the model's own coordinates imitate to a "
    "thousandth is one of them; less is rounding of the differences",
    "test_adequacy.py",
)
IMPLIED_BIAS = Limit(
    1.96,
    "standard deviations",
    "the half-width of the 95 % interval that is stated",
    "test_adequacy.py",
)
