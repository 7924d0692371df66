"""Every threshold of a decision about estimates, with its unit and its reason.

Those about recordings, gains and fleets stand beside their readers (`smp_motor_ident.bag.limits`,
`tune.limits`, `report.limits`); ``python scripts/limits.py > docs/limits.md`` prints all of them.
A reason is a significance level, a cost or a physical limit; that a record came out right is none.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """One threshold: its value and unit, why it is what it is, and the test that shows it."""

    value: float
    unit: str
    reason: str
    test: str


# Estimation: what is stated, and how surely.
NEIGHBOURS = Limit(
    -0.25, "correlation",
    "cost: half-way between counts over one sample (-1/2) and several (0); others are not tried",
    "test_differenced.py: a speed over several samples is no difference of neighbouring counts",
)  # fmt: skip
ONE_COUNT = Limit(
    1.5, "variances of a count's rounding",
    "physical: one count leaves one, the sum of two neighbours two",
    "test_differenced.py: a speed over several samples is no difference of neighbouring counts",
)  # fmt: skip
LOOSE_QUANTITY = Limit(
    0.5, "of its value",
    "a quantity known no better than to a factor of two (95 %) decides nothing",
    "test_poor_records.py: a single level of voltage gives one combination",
)  # fmt: skip
HIDDEN_LAG = Limit(
    1e-3, "of the first lag",
    "physical: at ten times the motor's bandwidth that lag turns the phase by 0.6 degrees",
    "test_poor_records.py: a second lag of next to nothing that is not known is not stated",
)  # fmt: skip
NEGLIGIBLE_FRICTION = Limit(
    0.05, "V",
    "Coulomb friction certain to that much may be nothing: half a percent of 10 V",
    "test_estimate.py: a linear motor is recovered without friction",
)  # fmt: skip
HOMOGENEITY = Limit(
    0.01, "significance level",
    "one record in a hundred of a motor that does not change may be called one that does",
    "test_segments.py: a motor that does not change is rarely said to",
)  # fmt: skip
SEGMENTS = Limit(
    8, "parts of a record",
    "enough for a scatter (a factor of 1.2 by Student's t), few enough for each to know the motor",
    "test_segments.py: a motor that warms up",
)  # fmt: skip
TEMPERATURE = Limit(
    5.0, "K, a standard deviation",
    "physical: what a room differs by from day to day, and a warm motor from a cold one",
    "test_segments.py: the interval of a motor that changes holds another days friction",
)  # fmt: skip
SEGMENT_INFORMATION = Limit(
    0.25, "of the average part's",
    "a part whose interval is more than twice the others' adds its noise, not the motor's change",
    "test_segments.py: parts without excitation do not count",
)  # fmt: skip
DISTURBED = Limit(
    1e-3, "significance level",
    "one record in a thousand of a motor under a load that fluctuates may lose a part for nothing",
    "test_disturbance.py: nothing is left out under torque noise or a drift",
)  # fmt: skip
LEFT_OUT = Limit(
    0.2, "of the record",
    "cost: what happens for longer than a fifth of the time is how the robot is, not an accident",
    "test_disturbance.py: a motor that something holds half of the time is not mended",
)  # fmt: skip
FEW_TRANSIENTS = Limit(
    8.0, "runs of samples", "a variance of fewer sums is known to no better than its half",
    "test_transients.py: a step alone scatters as it says",
)  # fmt: skip
REST = Limit(
    0.05, "of the largest voltage",
    "a motor that does not move at a twentieth of the voltage shows what it shows at none",
    "test_poor_records.py: rest before the excitation changes nothing",
)  # fmt: skip
SAME_LEVEL = Limit(
    0.02, "of a voltage",
    "levels closer than a voltmeter and a battery under load hold them are one level",
    "test_poor_records.py: a single level of voltage gives one combination",
)  # fmt: skip
CURRENT_THERE = Limit(
    0.3, "share of the samples",
    "cost: with less of the current its noise decides more than the motor does",
    "test_estimate.py: a current that is rarely there is not used",
)  # fmt: skip
CURRENT_KIND = Limit(
    0.5, "of what the armature's equation leaves",
    "cost: a current is taken for what it is called unless another equation of as many "
    "coefficients leaves half of the squares; noise leaves as much of either",
    "test_current_kind.py",
)  # fmt: skip
INSTANT = Limit(
    0.01, "sample",
    "physical: a command on a clock of its own, or stamps that jitter, are known to a hundredth of "
    "an interval at best",
    "test_intervals.py",
)  # fmt: skip
HOLD_COST = Limit(
    400_000, "samples", "cost: a second fit of a longer record takes seconds", "test_mirror.py"
)
HOLD_HOPELESS = Limit(
    100.0, "deviance", "cost: nothing makes up for odds of e^50 to 1 on a subset", "test_mirror.py"
)
HOLD_EVIDENCE = Limit(
    30.0, "deviance", "significance: odds of e^15 to 1 against what was recorded", "test_mirror.py"
)
WORST_FIT = Limit(
    30.0, "% of the speed",
    "below it half of the motion's variance comes from elsewhere: what is fitted is not the motor",
    "test_data_quality.py",
)  # fmt: skip
LEAST_FIT = Limit(
    -100.0, "% of the speed",
    "an error twice the motion is no fit to compare: a descent that left the motor behind",
    "test_estimate.py: a candidate that left the motor behind has no fit",
)  # fmt: skip
PROFILED = Limit(
    20_000, "samples", "cost: each end of an interval is found by a descent", "test_intervals.py"
)

# Choice of a candidate structure.
PRIOR_ODDS = Limit(
    4.0, "deviance per parameter",
    "significance: prior odds of e^2 to 1 against any addition, because many are tried",
    "test_structure_choice.py",
)  # fmt: skip
COLOURED = Limit(
    4.0, "ratio of variances", "significance: 1e-22 for 60 white runs", "test_structure_choice.py"
)
SURE_GAIN = Limit(
    3.0, "prices", "significance: 5e-14 for a parameter of 500 samples", "test_structure_choice.py"
)
LOOSE_ADDITION = Limit(
    0.4, "of its value, or e-folds",
    "significance: 2.5 deviations from nothing, one addition in eighty that is not there",
    "test_structure_choice.py: what is not known to two fifths",
)  # fmt: skip
SUBSET_HOPELESS = Limit(
    40.0, "deviance",
    "cost: odds of e^20 to 1 on the screening subset are not made up for by more data",
    "test_estimate.py: a candidate that left the motor behind has no fit",
)  # fmt: skip
SECOND_LAG = Limit(
    20.0, "deviance",
    "physical: every motor has a second lag, few a delay: up to odds of e^10 to 1 it is the lag",
    "test_averaging.py: a lag that may be a delay",
)  # fmt: skip
LITTLE_FRICTION = Limit(
    0.02, "of the largest voltage",
    "physical: friction below a fiftieth of what drives changes a gain by less than that",
    "test_estimate.py: a linear motor is recovered without friction",
)  # fmt: skip
TORQUE_NOISE = Limit(
    12.0, "deviance", "significance: odds of e^6 to 1 for an unrecorded load", "test_intervals.py"
)
MOST_FRICTION = Limit(
    0.98, "of what drives",
    "physical: beyond it, of a0 (viscous) or of the voltage (Coulomb), no motor would have turned",
    "test_shape_constraint.py",
)  # fmt: skip
PROFILE_FROM = Limit(
    0.1, "relative standard deviation",
    "physical: a coordinate that acts as its exponential is a tenth off its parabola there",
    "test_intervals.py",
)  # fmt: skip

# Assessment of a fit.
FIT_EXPLAINS = Limit(
    70.0, "% of the speed",
    "below it a third of the motion comes from elsewhere; no interval of a "
    "model that lacks a third of what happens means anything",
    "test_findings.py",
)  # fmt: skip
FIT_HOLDS = Limit(
    15.0, "% of the speed",
    "held-out data that are fitted so much worse are of another motor or "
    "load; chance alone changes a fit by parts of a percent",
    "test_findings.py",
)  # fmt: skip
FIT_INDEPENDENT = Limit(
    95.0, "% of the speed",
    "what follows the voltage in the last twentieth of the motion changes "
    "the gain by less than that",
    "test_findings.py",
)  # fmt: skip
UNEXPLAINED = Limit(
    9.0, "ratio of variances",
    "an encoder's rounding has a variance of a twelfth of a count; three "
    "times its deviation is beyond any counter",
    "test_findings.py",
)  # fmt: skip
RINGING = Limit(
    1.5, "rad per sample",
    "at pi a ringing cannot be distinguished from a slower one; at half of that "
    "sampling between two swings still shows both",
    "test_findings.py",
)  # fmt: skip
STEADY = Limit(4.0, "time constants", "98 % of a step are over", "test_estimate.py")
WINDING_LAG = Limit(
    0.25, "of the first lag",
    "physical: that is an L/R of a sixth of R J/K^2; catalogues of brushed motors have less than a "
    "tenth, and a wheel's inertia makes that smaller",
    "test_findings.py: a speed that is filtered as slowly as the motor turns",
)  # fmt: skip
SQUARE_LEVEL = Limit(
    0.03, "share of the level", "what a voltmeter scatters around a level", "test_estimate.py"
)
FRICTION_SHOWN = Limit(
    0.5, "relative standard deviation", "beyond it the 95 % interval holds zero", "test_findings.py"
)
FEWEST = Limit(
    40, "samples", "ten for each of gain, lag, friction and initial state", "test_data_quality.py"
)
MOST_LOST = Limit(
    0.3, "share of the samples", "beyond it the sensor is at fault", "test_data_quality.py"
)
METER = Limit(
    0.01, "share of the supply or of a level", "what a voltmeter scatters", "test_data_quality.py"
)
SILENT_SWING = Limit(
    2.0, "smallest steps of the sensor",
    "physical: rounding hides a swing of up to one; the other is for what the rest of a record "
    "does not tell of the lag, the winding and the friction that make the swing small",
    "test_silence.py",
)  # fmt: skip
FLICKER = Limit(
    3.0, "ratio of changes of level",
    "physical: counts differenced faster than they come change level at most samples, a rounded "
    "speed once a crossing; what is expected of the motion is known to a factor of two",
    "test_silence.py",
)  # fmt: skip
OFFSET_SURE = Limit(
    6.0, "standard deviations",
    "of an offset of the current, with errors of neighbouring runs that "
    "hang together allowed for; chance exceeds it once in 5e8",
    "test_data_quality.py",
)  # fmt: skip
LARGEST_OFFSET = Limit(
    0.2, "share of the largest current", "no calibrated sensor has more", "test_data_quality.py"
)
SIGN_SURE = Limit(
    4.0, "standard deviations",
    "of the correlation of two signals that have no part in each other; the largest of its lags "
    "exceeds it by chance once in 2000 records of a standing motor",
    "test_signs.py",
)  # fmt: skip
SIGN_LEAST = Limit(
    0.2, "correlation", "what explains less than a twentieth of a signal shows no sign of it",
    "test_signs.py",
)  # fmt: skip
BACKWARD = Limit(
    0.1, "of the way",
    "physical: a load turns a motor back against a voltage of one sign, but not for long",
    "test_lost_sign.py: a command without its sign is refused and says so",
)  # fmt: skip
HALF_EXPLAINED = Limit(
    0.5, "of the variance", "most of what there is",
    "test_lost_sign.py: a speed without its sign is refused and says so",
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
    "of a sample come so near to any phase, and the sign of what is nearer tells nothing",
    "test_signs.py",
)  # fmt: skip
SIGN_LATE = Limit(
    2.0, "samples",
    "physical: a driver and an encoder of one clock each are half a sample late on average and one "
    "at most; a longer transport is long beside a sample, not beside a motor",
    "test_signs.py",
)  # fmt: skip
RESIDUAL_LEVEL = Limit(
    0.05, "probability", "that any lag of clean residuals leaves its band", "test_findings.py"
)

# Adequacy of the model.
EFFECT_LEVEL = Limit(
    0.001, "probability",
    "that a clean record shows any effect (Bonferroni): 0.01 would stop one commissioning in 25",
    "test_adequacy.py",
)  # fmt: skip
EFFECT_COVERED = Limit(
    0.05, "probability",
    "that a clean record's 95 % intervals are wider by an effect that is not there (Bonferroni)",
    "test_adequacy.py",
)  # fmt: skip
CONDITION_LEVEL = Limit(
    0.01, "probability", "that clean numbers seem to hang on a condition", "test_adequacy.py"
)
CONDITION_WEIGHT = Limit(
    0.8, "share of the weight",
    "nine to one: nearly half of the data alone, and yet no number is lost that one half lacks",
    "test_adequacy.py",
)  # fmt: skip
EFFECT_BLOCKS = Limit(
    6, "degrees of freedom", "with fewer the level of a test is unknown", "test_adequacy.py"
)
EFFECT_OWN = Limit(
    1e-2, "share of the sum of squares",
    "an effect's shape is known to a tenth at best: what the model imitates so far shows nothing",
    "test_adequacy.py",
)  # fmt: skip
SWING = Limit(
    1.0, "rad", "physical: over less a weight's torque changes by less than itself: it is a load",
    "test_noise_or_effect.py: a weight that a motor lifts is named",
)  # fmt: skip
BUNCHED = Limit(
    0.05, "share of the mean interval",
    "cost: the start puts the samples on a grid of their median interval, of 20 times as many "
    "points as there are samples at this share, and without end where stamps are equal",
    "test_bunched.py",
)  # fmt: skip
ROWS_LOST = Limit(
    2, "samples", "physical: over more of them a command is no straight line", "test_lost_rows.py"
)
HALF_WIDTH = Limit(
    1.96, "standard deviations", "half-width of the stated 95 % interval", "test_adequacy.py"
)
LATE_ROWS = Limit(
    3, "rows", "physical: a firmware's speed commonly comes up to two periods late, and is held",
    "test_data_quality.py: a speed that settles on its resolution is not saturated",
)  # fmt: skip
AT_LIMIT = Limit(
    5, "rows", "cost: of fewer at a limit neither their voltages nor their run say anything",
    "test_data_quality.py: a peak that is held for some rows is not saturated",
)  # fmt: skip
LONGEST_LAG = Limit(
    10.0, "s", "physical: a flywheel of a hundred rotors runs up within seconds",
    "test_poor_records.py: a motor that cannot be is said to be none",
)  # fmt: skip
EXTRA_LOW_VOLTAGE = Limit(
    60.0, "V", "physical: extra-low voltage ends there, and with it what robots are built with",
    "test_lost_sign.py: a duty in counts that is called a voltage is questioned",
)  # fmt: skip
LOW_VOLTAGE = Limit(
    1500.0, "V", "physical: the end of low direct voltage (IEC 60038), and with it of motors",
    "test_lost_sign.py: thousands of volts are questioned whatever they are",
)  # fmt: skip
LONG_DELAY = Limit(
    3.0, "time constants", "physical: a motor is over its transient before it would begin",
    "test_poor_records.py: a ramp that overcomes friction late is no delay",
)  # fmt: skip
SHARP = Limit(
    0.25, "of the command's range", "physical: a step of that overcomes any friction at once",
    "test_poor_records.py: a ramp that overcomes friction late is no delay",
)  # fmt: skip
HIGHEST_GAIN = Limit(
    2000.0, "rad/s/V", "physical: 19,000 rpm per volt, twice that of the fastest models' motors",
    "test_poor_records.py: a motor that cannot be is said to be none",
)  # fmt: skip
RELEVANT_BIAS = Limit(
    0.02, "of a number, or of a sampling interval for a delay",
    "costs a loop a fiftieth of its bandwidth or of its sampling interval: less than any margin",
    "test_adequacy.py",
)  # fmt: skip
CANDIDATE_WEIGHT = Limit(
    0.05, "probability",
    "a structure that explains the data best less often than that is rejected at the 5 % level",
    "test_averaging.py: a lag that may be a delay",
)  # fmt: skip

# A commissioned motor that is followed while it drives.
RESISTANCE_BAND = Limit(
    0.15, "of the commissioned value",
    "38 K of copper: a motor at work warms by less, and its insulation bears twice that",
    "test_monitor.py: a winding that heats",
)  # fmt: skip
MOTOR_CONSTANT_BAND = Limit(
    0.03, "of the commissioned value",
    "15 K of ferrite at 0.2 %/K, what magnets warm by beside a winding at the end of its band",
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
