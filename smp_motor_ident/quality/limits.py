# SPDX-License-Identifier: Apache-2.0
"""Thresholds of decisions about recordings, with their reasons."""

from smp_motor_ident.limits import Limit

# Estimation: conditions on stated values.
NEIGHBOURS = Limit(
    -0.25, "correlation",
    "cost: half-way between counts over one sample (-1/2) and several (0); others are not tried",
    "test_differenced.py: a speed over several samples is not a difference of neighbouring counts",
)  # fmt: skip
ONE_COUNT = Limit(
    1.5, "variances of a count's rounding",
    "physical: one count leaves one, the sum of two neighbours two",
    "test_differenced.py: a speed over several samples is not a difference of neighbouring counts",
)  # fmt: skip
LOOSE_QUANTITY = Limit(
    0.5, "of its value",
    "a quantity uncertain by a factor of two (95 %) decides nothing",
    "test_poor_records.py: a single level of voltage gives one combination",
)  # fmt: skip
REST = Limit(
    0.05, "of the largest voltage",
    "the response of a motor at rest at a twentieth of the voltage is that at zero",
    "test_poor_records.py: rest before the excitation changes nothing",
)  # fmt: skip
SAME_LEVEL = Limit(
    0.02, "of a voltage",
    "levels closer than a voltmeter and a battery under load hold them are one level",
    "test_poor_records.py: a single level of voltage gives one combination",
)  # fmt: skip
CURRENT_THERE = Limit(
    0.3, "share of the samples",
    "cost: with less of the current its noise outweighs the motor",
    "test_estimate.py: a current that is rarely there is not used",
)  # fmt: skip
WORST_FIT = Limit(
    30.0, "% of the speed",
    "below it half of the motion's variance comes from elsewhere; the fit is not of the motor",
    "test_data_quality.py",
)  # fmt: skip

# Assessment of a fit.
FIT_EXPLAINS = Limit(
    70.0, "% of the speed",
    "below it a third of the motion comes from elsewhere, and the intervals of such a model mean "
    "nothing",
    "test_findings.py",
)  # fmt: skip
FIT_HOLDS = Limit(
    15.0, "% of the speed",
    "held-out data that are fitted so much worse are of another motor or "
    "load; chance alone changes a fit by parts of a percent",
    "test_findings.py",
)  # fmt: skip
UNEXPLAINED = Limit(
    9.0, "ratio of variances",
    "an encoder's rounding has a variance of a twelfth of a count; three "
    "times its deviation is beyond any counter",
    "test_findings.py",
)  # fmt: skip
FEWEST = Limit(
    40, "samples", "ten for each of gain, lag, friction and initial state", "test_data_quality.py"
)
MOST_LOST = Limit(
    0.3, "share of the samples", "beyond it the sensor is at fault", "test_data_quality.py"
)
METER = Limit(
    0.01, "share of the supply or of a level", "scatter of a voltmeter", "test_data_quality.py"
)
SILENT_SWING = Limit(
    2.0, "smallest steps of the sensor",
    "physical: rounding hides a swing of up to one; the other allows for the uncertainty of lag, "
    "winding and friction, which reduce the swing",
    "test_silence.py",
)  # fmt: skip
FLICKER = Limit(
    3.0, "ratio of changes of level",
    "physical: counts differenced faster than they come change level at most samples, a rounded "
    "speed once a crossing; the expected motion is known to a factor of two",
    "test_silence.py",
)  # fmt: skip
LARGEST_OFFSET = Limit(
    0.2, "share of the largest current", "no calibrated sensor has more", "test_data_quality.py"
)
SIGN_SURE = Limit(
    4.0, "standard deviations",
    "of the correlation of independent signals; the maximum over its lags exceeds it by chance "
    "once in 2000 records of a standing motor",
    "test_signs.py",
)  # fmt: skip
SIGN_LEAST = Limit(
    0.2, "correlation", "explaining less than a twentieth of a signal does not determine its sign",
    "test_signs.py",
)  # fmt: skip
BACKWARD = Limit(
    0.1, "of the way",
    "physical: a load turns a motor back against a voltage of one sign, but not for long",
    "test_lost_sign.py: a command without its sign is refused by name",
)  # fmt: skip
HALF_EXPLAINED = Limit(
    0.5, "of the variance", "the larger part",
    "test_lost_sign.py: a speed without its sign is refused by name",
)  # fmt: skip
SIGN_ALIKE = Limit(
    0.5, "correlation, or share of one",
    "a quarter of the motion follows the voltage: it turns, however slowly the voltage changes; "
    "the cosine of 60 degrees, twice what delays between those tried may miss (SIGN_NEARER)",
    "test_signs.py",
)  # fmt: skip
SIGN_NEARER = Limit(
    0.87, "share of a correlation",
    "physical: cosine of 30 degrees; at three samples to a period, delays that are tried in halves "
    "of a sample match any phase so well, and a better match does not determine the sign",
    "test_signs.py",
)  # fmt: skip
SIGN_LATE = Limit(
    2.0, "samples",
    "physical: a driver and an encoder of one clock each are half a sample late on average and one "
    "at most; a longer transport is long compared with a sample, but not with a motor",
    "test_signs.py",
)  # fmt: skip
RESIDUAL_LEVEL = Limit(
    0.05, "probability", "that any lag of clean residuals leaves its band", "test_findings.py"
)

# Adequacy of the model.
BUNCHED = Limit(
    0.05, "share of the mean interval",
    "cost: the start puts the samples on a grid of their median interval, of 20 times as many "
    "points as there are samples at this share, and without end where stamps are equal",
    "test_bunched.py",
)  # fmt: skip
ROWS_LOST = Limit(
    2,
    "samples",
    "physical: over more of them a command is not a straight line",
    "test_lost_rows.py",
)
HALF_WIDTH = Limit(
    1.96,
    "standard deviations",
    "half-width of the stated 95 % interval",
    "test_monitor.py: a winding that heats",
)
LATE_ROWS = Limit(
    3, "rows", "physical: a firmware's speed commonly comes up to two periods late, and is held",
    "test_data_quality.py: a speed that settles on its resolution is not saturated",
)  # fmt: skip
AT_LIMIT = Limit(
    5, "rows", "cost: fewer rows at a limit show neither saturation nor its absence",
    "test_data_quality.py: a peak that is held for some rows is not saturated",
)  # fmt: skip
LONGEST_LAG = Limit(
    10.0, "s", "physical: a flywheel of a hundred rotors runs up within seconds",
    "test_poor_records.py: an impossible motor is reported",
)  # fmt: skip
EXTRA_LOW_VOLTAGE = Limit(
    60.0, "V", "physical: the end of extra-low voltage, and of the voltages of robots",
    "test_lost_sign.py: a duty in counts that is called a voltage is questioned",
)  # fmt: skip
LOW_VOLTAGE = Limit(
    1500.0, "V", "physical: the end of low direct voltage (IEC 60038), and with it of motors",
    "test_lost_sign.py: thousands of volts are questioned",
)  # fmt: skip
HIGHEST_GAIN = Limit(
    2000.0, "rad/s/V", "physical: 19,000 rpm per volt, twice that of the fastest models' motors",
    "test_poor_records.py: an impossible motor is reported",
)  # fmt: skip

# A commissioned motor that is followed while it drives.
RESISTANCE_BAND = Limit(
    0.15, "of the commissioned value",
    "38 K of copper: a motor at work warms by less, and its insulation bears twice that",
    "test_monitor.py: a winding that heats",
)  # fmt: skip
MOTOR_CONSTANT_BAND = Limit(
    0.03, "of the commissioned value",
    "15 K of ferrite at 0.2 %/K, the warming of magnets next to a winding at the end of its band",
    "test_monitor.py: a magnet that weakens is separated from heat",
)  # fmt: skip
FRICTION_BAND = Limit(
    1.0, "of the commissioned value",
    "a floor instead of blocks adds its rolling resistance, about as much again",
    "test_monitor.py: half an hour of ordinary driving",
)  # fmt: skip
LEFT_BAND = Limit(
    3.0, "s of motion outside of a band",
    "a single load or a bad sample is over by then; a motor that burns takes longer",
    "test_monitor.py: half an hour of ordinary driving",
)  # fmt: skip
