"""Thresholds of what single samples are: instants, readings, and the driver between them."""

from smp_motor_ident.diagnosis.limits import Limit

# Stamps of arrival, put back on the beat of their sender.
BEAT_FLOOR = Limit(0.5, "sample", "physical: later than half a sample is the next", "test_beat.py")
BEAT_JITTER = Limit(
    0.02, "sample", "cost: instants off by less matter less than their rounding", "test_beat.py"
)
BEAT_LOST = Limit(0.02, "1", "cost: with more lost a sample's number is a guess", "test_beat.py")
SMOOTHER = Limit(
    3.1, "standard deviations", "sign test of size 1e-3, else stamps are kept", "test_beat.py"
)

# Readings that are none of the motor.
GLITCH = Limit(
    10.0, "upper quartiles of a reading's jump beyond both neighbours",
    "nine deviations of white noise: chance reaches them in no record",
    "test_glitches.py: what noise and a fast motor do is no glitch",
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
    "test_saturation.py: a current that a driver regulates is no clipped one",
)  # fmt: skip
NOMINAL_PERIOD = Limit(
    0.5, "slope",
    "cost: half-way between a motor's speed (0) and counts over a period that is always the same "
    "(1), by which the gain is off as much as intervals are",
    "test_differenced.py: counts over a nominal period are a speed over the real intervals",
)  # fmt: skip
EDGES = Limit(
    12, "readings",
    "cost: of fewer that are held for as long as the next one says, chance makes some",
    "test_edge_timer.py: a speed from counts rounded or held is none of a timer",
)  # fmt: skip
HELD = Limit(
    0.85, "of the slow readings",
    "cost: reversals and rests begin a time that is not one of a count; what another sensor holds "
    "is held for as long as the next says in a third of the cases at most",
    "test_edge_timer.py: a speed from counts rounded or held is none of a timer",
)  # fmt: skip

EDGE_SPEED = Limit(
    1e-3, "of the largest speed",
    "cost: readings that are held below it are late by nothing that moves a number; the tail of a "
    "filter decays through as many small readings as one likes",
    "test_edge_timer.py: the tail of a filter is none of a timer",
)  # fmt: skip
COMMAND_AHEAD = Limit(
    0.25, "sample",
    "cost: between no delay and half a sample, by which a filter that firmware runs row by row is "
    "ahead of two lags; a longer one takes back that a command was read an interval late",
    "test_findings.py: a speed that is filtered as slowly as the motor turns",
)  # fmt: skip
COUNTS_A_SAMPLE = Limit(
    2.0, "counts",
    "cost: of that many at most a difference of counts is no speed, and they are summed whatever "
    "moves the motor; of more it can be read, and a motor has to leave one count's rounding",
    "test_differenced.py: counts are seen in a speed of a motor that no model explains",
)  # fmt: skip

# A driver's effect on its command.
EFFECT_SHOWN = Limit(
    0.5, "relative standard deviation",
    "beyond it the 95 % interval holds a driver without that effect",
    "test_driver_evidence.py: a size that may be nothing is not stated",
)  # fmt: skip
DRIVER_TOLERANCE = Limit(
    0.01, "of its size",
    "physical: the reference of a current's limit holds to a percent, and the drop of a transistor "
    "or a brush changes by that in two kelvin",
    "test_driver_effect.py: a driver that limits the current is found and designed for",
)  # fmt: skip
SLEW_SEEN = Limit(
    0.5, "sample",
    "physical: a voltage that is there within half a sample lacks a quarter of one row at most: a "
    "clock or a delay of that much is no less likely",
    "test_driver_evidence.py: a rise that is over between two rows is not stated",
)  # fmt: skip

# What no motor does, whatever the units of a recording say.
HIGHEST_SPEED = Limit(
    8400.0, "rad/s",
    "physical: 80,000 rpm, what brushes and bearings of the smallest coreless motors bear",
    "test_poor_records.py: a speed in rpm or a command in amperes makes a motor that hardly is",
)  # fmt: skip
FAST_MOTOR = Limit(
    4200.0, "rad/s",
    "physical: 40,000 rpm; motors of small geared drives end at 33,000 (N20), catalogues of "
    "coreless ones at 20,000; beyond are the motors of toys",
    "test_poor_records.py: a speed in rpm or a command in amperes makes a motor that hardly is",
)  # fmt: skip
ORDINARY_BEND = Limit(
    0.015, "of the largest voltage",
    "physical: a battery and leads of a twentieth of the winding's resistance, at a third of the "
    "stall current; a transistor's 0.2 V of 12 V: every drive has one of them",
    "test_adequacy.py: what hides in the motors own numbers is no larger than ordinary",
)  # fmt: skip
LARGEST_DROP = Limit(
    0.4, "of the supply",
    "physical: two Darlington transistors of a bridge take 4.9 V of 12 (L298, 2 A); what looks "
    "like more is a bridge that coasts",
    "test_driver_effect.py: an effect in volts is smaller than the command",
)  # fmt: skip
BRAKES = Limit(
    0.05, "of the largest command",
    "as far as a motor runs ahead of its command by more than its sensor's noise: of one that is "
    "only driven a drop is friction",
    "test_driver_joint.py: a drop is sought only where the motor brakes",
)  # fmt: skip
FIT_WITHOUT_NOISE = Limit(
    90.0, "% of the speed",
    "a tenth of the motion that neither a sensor's nor a torque's noise explains is the model's "
    "error, and its numbers are off by as much",
    "test_findings.py",
)  # fmt: skip
STILL_EXCITED = Limit(
    0.5, "of the voltage's changes",
    "cost: what is left tells the lags from as many transients as what is lost, or more",
    "test_disturbance.py: the only step of a record is not left out as a disturbance",
)  # fmt: skip
FRICTION_MOST = Limit(
    0.5, "of the largest voltage",
    "physical: geared motors start at a tenth to a third of what they are driven with; where less "
    "is left to move one than friction takes, the numbers are those of friction's own law, or of a "
    "driver that coasts between its pulses",
    "test_coasting_driver.py: a motor that friction nearly holds is unreliable",
)  # fmt: skip
LONGEST_WINDING = Limit(
    0.1, "s",
    "physical: four times the longest L/R of the paper's Table 1 (24 ms), which is long already; "
    "catalogues of motors below a kilowatt have some milliseconds",
    "test_findings.py: a drift is no winding",
)  # fmt: skip
LEFT_BY_SILENCE = Limit(
    0.5, "share of a record",
    "what does not show the motor in most of a record is an encoder to be mended",
    "test_silence.py: a motor that is blocked for a while is estimated from the rest",
)  # fmt: skip
