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


# Estimation: what is stated, and how surely.
LOOSE_QUANTITY = Limit(
    0.5,
    "of its value",
    "a quantity known no better than to a factor of two (95 %) decides nothing",
    "test_poor_records.py: a single level of voltage gives one combination",
)
NEGLIGIBLE_FRICTION = Limit(
    0.05,
    "V",
    "Coulomb friction certain to that much may be nothing: half a percent of 10 V",
    "test_estimate.py: a linear motor is recovered without friction",
)
HOMOGENEITY = Limit(
    0.01,
    "significance level",
    "one record in a hundred of a motor that does not change may be called one that does",
    "test_segments.py: a motor that does not change is rarely said to",
)
SEGMENTS = Limit(
    8,
    "parts of a record",
    "enough for a scatter (a factor of 1.2 by Student's t), few enough for each to know the motor",
    "test_segments.py: a motor that warms up",
)
SEGMENT_INFORMATION = Limit(
    0.25,
    "of the average part's",
    "a part whose interval is more than twice the others' adds its noise, not the motor's change",
    "test_segments.py: parts without excitation do not count",
)
REST = Limit(
    0.05,
    "of the largest voltage",
    "a motor that does not move at a twentieth of the voltage shows what it shows at none",
    "test_poor_records.py: rest before the excitation changes nothing",
)
SAME_LEVEL = Limit(
    0.02,
    "of a voltage",
    "levels closer than a voltmeter and a battery under load hold them are one level",
    "test_poor_records.py: a single level of voltage gives one combination",
)
CURRENT_THERE = Limit(
    0.3,
    "share of the samples",
    "cost: with less of the current its noise decides more than the motor does",
    "test_estimate.py: a current that is rarely there is not used",
)
CURRENT_KIND = Limit(
    0.5,
    "of what the armature's equation leaves",
    "cost: a current is taken for what it is called unless another equation of as many "
    "coefficients leaves half of the squares; noise leaves as much of either",
    "test_current_kind.py",
)
INSTANT = Limit(
    0.01,
    "sample",
    "physical: a command on a clock of its own, or stamps that jitter, are known to a hundredth of "
    "an interval at best",
    "test_intervals.py",
)
HOLD_COST = Limit(
    400_000,
    "samples",
    "cost: a second fit of a longer record takes seconds, and the instants average out",
    "test_mirror.py",
)
HOLD_HOPELESS = Limit(
    100.0,
    "deviance",
    "cost: no more data make up for odds of e^50 to 1 on the screening subset",
    "test_mirror.py",
)
HOLD_EVIDENCE = Limit(
    30.0,
    "deviance",
    "significance: odds of e^15 to 1 against the command as it was recorded, which is what most "
    "drivers do",
    "test_mirror.py",
)
WORST_FIT = Limit(
    30.0,
    "% of the speed",
    "below it half of the motion's variance comes from elsewhere: what is fitted is not the motor",
    "test_screening.py",
)
LEAST_FIT = Limit(
    -100.0,
    "% of the speed",
    "an error twice the motion is no fit to compare: a descent that left the motor behind",
    "test_estimate.py: a candidate that left the motor behind has no fit",
)
PROFILED = Limit(
    20_000,
    "samples",
    "cost: ends of an interval are found on as few samples as tell the same, each a descent",
    "test_intervals.py",
)

# Reading recordings (smp_motor_ident.bag).
UNPACKED_LEAST = Limit(
    256e6,
    "byte",
    "cost: what any machine that runs ROS can spare; a smaller file may always unpack to it",
    "test_bounds.py",
)
UNPACKED_RATIO = Limit(
    50.0,
    "1",
    "cost: 1 GB at most for a file of 10 MB, half of it unpacked bytes; telemetry packs 3 to 20",
    "test_bounds.py",
)
STRAY_ROWS = Limit(
    0.05,
    "1",
    "cost: an estimate without one row in twenty keeps its value; with more it is no table",
    "test_csv.py",
)
BEAT_FLOOR = Limit(
    0.5,
    "sample",
    "physical: a later beat than half a sample is the next one; the least latency stays below it",
    "test_beat.py",
)
BEAT_JITTER = Limit(
    0.02,
    "sample",
    "cost: instants that are off by less change an estimate less than their rounding",
    "test_beat.py",
)
BEAT_LOST = Limit(
    0.02,
    "1",
    "cost: with more samples lost the number of a sample, and with it its instant, is a guess",
    "test_beat.py",
)
JUMP_SPAN = Limit(
    20.0,
    "1",
    "physical: no signal leaves twenty times the range of 98 % of its values for single samples",
    "test_checks.py",
)
JUMP_STEP = Limit(
    20.0,
    "1",
    "physical: what has inertia does not step to and fro by twenty times all but 1 % of its steps",
    "test_checks.py",
)
UNSIGNED_CURRENT = Limit(
    2.0,
    "1",
    "physical: an armature's means in both directions cancel but for an offset; a size's add up",
    "test_checks.py",
)
SMOOTHER = Limit(
    0.9,
    "1",
    "cost: stamps are kept unless the motion is evidently smoother on the beat that they keep",
    "test_beat.py",
)
EXPLAINS = Limit(
    1e-6,
    "1",
    "significance: with a thousand pairs of fields tried, one in a thousand listings is wrong",
    "test_propose.py",
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
    "at pi a ringing cannot be distinguished from a slower one; at half of that "
    "sampling between two swings still shows both",
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
SIGN_SURE = Limit(
    4.0,
    "standard deviations",
    "of the correlation of two signals that have no part in each other; the largest of twelve "
    "lags exceeds it by chance once in 2000 records of a standing motor",
    "test_screening.py",
)
SAME_MOTOR = Limit(
    0.01,
    "probability",
    "that records of one motor differ by so much by chance in any quantity",
    "test_records.py",
)
SIGN_ALIKE = Limit(
    0.5,
    "correlation",
    "a quarter of the motion follows the voltage: it turns, however slowly the voltage changes",
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
    1e-2,
    "share of the sum of squares",
    "the shape of an effect (of a friction curve, of a supply) is known to a tenth at best: what "
    "the model's own coordinates imitate to a tenth cannot be separated from them",
    "test_adequacy.py",
)
BUNCHED = Limit(
    0.05,
    "share of the mean interval",
    "cost: the start puts the samples on a grid of their median interval, of 20 times as many "
    "points as there are samples at this share, and without end where stamps are equal",
    "test_bunched.py",
)
IMPLIED_BIAS = Limit(
    1.96,
    "standard deviations",
    "the half-width of the 95 % interval that is stated",
    "test_adequacy.py",
)

RELEVANT_BIAS = Limit(
    0.02,
    "of a number, or of a sampling interval for a delay",
    "costs a loop a fiftieth of its bandwidth or of its sampling interval: less than any margin",
    "test_adequacy.py",
)


# Tuning: what may be designed on, and how far gains may go.

FRICTION_KNOWN = Limit(
    0.02,
    "share of the supply",
    "an error of the friction's feed-forward by this changes the speed by as much of its largest "
    "value as the band in which a change counts as settled",
    "test_tune_truth.py",
)
FRICTION_RANGE = Limit(
    0.5,
    "share of the supply",
    "with half of the supply unknown the speed that the motor reaches is not known to a factor 2",
    "test_tune_truth.py",
)
UNRELIABLE_SPREAD = Limit(
    0.1,
    "relative standard deviation",
    "least that numbers of an unreliable estimate are drawn with; more where the fit on held-out "
    "data leaves more of the motion unexplained",
    "test_tune_truth.py",
)
SPEED_NOISE = Limit(
    2.5e-3,
    "share of the top speed, rms",
    "four times this is 2 % of half the top speed: with more, counts shake the wheel out of the "
    "band in which the specification calls a change settled",
    "test_tune_methods.py",
)
CANDIDATE_WEIGHT = Limit(
    0.05,
    "probability",
    "a structure that explains the data best less often than that is rejected at the 5 % level",
    "test_averaging.py: a lag that may be a delay",
)

# A commissioned motor that is followed while it drives.
RESISTANCE_BAND = Limit(
    0.15,
    "of the commissioned value",
    "38 K of copper: a motor at work warms by less, and its insulation bears twice that",
    "test_monitor.py: a winding that heats",
)
MOTOR_CONSTANT_BAND = Limit(
    0.03,
    "of the commissioned value",
    "15 K of ferrite at 0.2 %/K, what magnets warm by beside a winding at the end of its band",
    "test_monitor.py: a magnet that weakens is separated from heat",
)
FRICTION_BAND = Limit(
    1.0,
    "of the commissioned value",
    "a floor instead of blocks adds its rolling resistance, about as much again",
    "test_monitor.py: half an hour of ordinary driving",
)
OUTSIDE = Limit(
    2.0,
    "standard deviations",
    "2.3 % of chance for one look at one value, which must stay outside besides",
    "test_monitor.py: half an hour of ordinary driving",
)
LEFT_BAND = Limit(
    3.0,
    "s of motion outside of a band",
    "a single load or a bad sample is over by then; a motor that burns takes longer",
    "test_monitor.py: half an hour of ordinary driving",
)

# Loops whose commands are reconstructed.
COMMAND_RESOLUTION = Limit(
    1 / 255,
    "of the supply, rms",
    "one step of an 8-bit PWM: a command that is known closer is known as well as it was given",
    "test_known_loop.py: what is not known is refused",
)
LOOP_RATE = Limit(
    0.02,
    "of the interval",
    "clocks of boards are within 2 %; a log at another rate leaves commands out",
    "test_known_loop.py: what is not known is refused",
)
TICK_FIT = Limit(
    0.05,
    "of a tick",
    "digits that put 95 % of speeds within a twentieth of a whole tick leave no doubt which",
    "test_known_loop.py: the command is reconstructed",
)

# Many robots.
FLEET_DRIFT = Limit(
    4.0,
    "standard deviations of the slope",
    "6 in 100,000 by chance: a thousand robots of four wheels and five quantities raise one",
    "test_fleet.py: a motor that drifts",
)
FLEET_OUTLIER = Limit(
    5.0,
    "scatters of the robots",
    "motors of one batch scatter with longer tails than a normal distribution has",
    "test_fleet.py: a motor unlike the others",
)
FLEET_SIZE = Limit(
    5,
    "robots",
    "with fewer, the median deviation itself is uncertain by half",
    "test_fleet.py: a motor unlike the others",
)

# Commissioning: a robot on blocks.
FEEDBACK_RATE = Limit(
    40.0,
    "samples per second",
    "a motor of 50 ms is then seen twice in its time constant; below, none of it is left to see",
    "test_wheel_checks.py: feedback that comes too seldom",
)
FEEDBACK_AGE = Limit(
    0.2,
    "s on arrival",
    "wheel_pid takes feedback that is older for lost, and stops the wheel",
    "test_wheel_checks.py: feedback that comes too seldom",
)
BREAKAWAY_COUNTS = Limit(
    10.0,
    "counts in one direction",
    "an encoder on an edge trembles by a count or two; what has counted ten has turned",
    "test_wheel_checks.py: a trembling encoder",
)
FRICTION_SHARE = Limit(
    0.1,
    "of the voltage",
    "where friction takes more, its error and not the motor decides the gain",
    "test_wheel_checks.py: the voltage grows until",
)
ANSWER_COUNTS = Limit(
    100.0,
    "counts while a voltage is held",
    "a steady speed that is resolved to one percent",
    "test_wheel_checks.py: the voltage grows until",
)
VELOCITY_RATIO = Limit(
    0.05,
    "of the speed from counts",
    "one encoder tells both, so only rounding may differ; gear ratios on offer differ by more",
    "test_wheel_checks.py: a gear ratio",
)
EXPECTED_GAIN = Limit(
    1.5,
    "times the data sheet's",
    "motors of one type differ by a tenth or two; counted edges or gears by a factor of two",
    "test_wheel_checks.py: a gear ratio",
)
DEAD_ZONE = Limit(
    0.05,
    "of the supply",
    "what feed-forward cannot know must be filled by the integral; a twentieth takes it one "
    "transition",
    "test_wheel_checks.py: a dead zone",
)
SUPPLY_SHORTFALL = Limit(
    0.1,
    "of the commanded voltage",
    "cost: the loop is slower, and its feed-forward short, by as much; batteries in order sag less",
    "test_wheel_checks.py: a weak battery",
)
SISTERS = Limit(
    3.0,
    "times the median of the other wheels",
    "frictions of one type of motor scatter by a half; three times is a brake",
    "test_wheel_checks.py: a wheel that drags",
)
SETTLED = Limit(
    0.02,
    "of a change of set-point",
    "the field's usual band of a settling time",
    "test_verification.py: a wheel that does as designed",
)
OVERSHOOT = Limit(
    0.01,
    "of a change of set-point",
    "what the reference is planned to overshoot at most: a load or a count may use it up",
    "test_verification.py: a wheel that does as designed",
)
SILENCE = Limit(
    0.1,
    "s without an answer",
    "half of what lets wheel_pid stop the wheel: such a drive shows the computer, not the gains",
    "test_verification.py: a drive without control",
)
STEADY_ERROR = Limit(
    0.02,
    "of a change of set-point",
    "the same band: integral action leaves no error, only what has not settled",
    "test_verification.py: a speed that stays off",
)
VALIDATION_LEVEL = Limit(
    0.01,
    "significance level",
    "one sound wheel in a hundred may be said to be worse on data that no fit has seen",
    "test_validation_run.py: a motor that did not change",
)
VALIDATION_SHARE = Limit(
    0.05,
    "of the speed's scatter",
    "cost: margins bear a gain that is off by more; a twentieth that is unexplained moves none",
    "test_validation_run.py: a motor that changed",
)
