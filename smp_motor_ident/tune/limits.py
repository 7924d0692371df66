# SPDX-License-Identifier: Apache-2.0
"""Thresholds for gains and loops, with units and reasons."""

from smp_motor_ident.infer.response_limits import RESONANCE_DAMPING
from smp_motor_ident.limits import Limit

# Requirements on the model, and limits of the gains.
MAX_FRICTION_ERROR = Limit(
    0.02,
    "share of the supply",
    "such an error of the feed-forward changes the speed by 2 % of its largest value, the band in "
    "which a change counts as settled",
    "test_tune_truth.py",
)
MAX_FRICTION_RANGE = Limit(
    0.5,
    "share of the supply",
    "if friction may take half of the supply, the reachable speed is uncertain by a factor of two",
    "test_tune_truth.py",
)
MIN_UNRELIABLE_STD = Limit(
    0.1,
    "relative standard deviation",
    "assumed for every number of an unreliable estimate; more where the fit of held-out data "
    "leaves "
    "more of the motion unexplained",
    "test_tune_truth.py",
)
MAX_STATED_GAIN_MARGIN = Limit(
    10.0,
    "times the gain",
    "physical: with ten times the gain, half a row of delay or averaging, which no record "
    "excludes, "
    "shifts the phase at crossover by tens of degrees",
    "test_tune_truth.py",
)
MAX_SPEED_NOISE = Limit(
    2.5e-3,
    "share of the top speed, rms",
    "four standard deviations are then 2 % of half the top speed; more noise would leave the band "
    "in which a change counts as settled",
    "test_tune_methods.py",
)
MIN_OUTLIER_DEVIATIONS = Limit(
    8.0,
    "standard deviations of a reported speed's noise",
    "significance: two readings differ by more once in 70 million, a day at 1 kHz",
    "test_tune_disturbances.py: outliers do not reach the loop",
)

UNKNOWN_RESPONSE_ERROR = Limit(
    2.0,
    "of the model's response",
    "assumed relative error at frequencies without excitation: the smallest that Skogestad and "
    "Postlethwaite (2005), section 7.4.2, assume at high frequencies, where phase and size of the "
    "response are unknown",
    "test_tune_unmodelled.py: the loop stays within the excited band",
)
RESONANCE_ERROR = Limit(
    1 / (2 * RESONANCE_DAMPING.value),
    "of the model's response",
    "physical: 1/(2 zeta) of a shaft with the damping ratio 0.05 of steel in its bearings",
    "test_tune_unmodelled.py: error that is shown counts for a resonance",
)
MAX_RESONANCE_DAMPING = Limit(
    0.5,
    "damping ratio",
    "physical: the largest of a shaft; with more, a step overshoots once, by at most 16 %",
    "test_tune_unmodelled.py: the effect of a resonance equals that of a simulated one",
)
MIN_LIMITING_SHARE = Limit(
    0.97,
    "of the tolerated unmodelled dynamics",
    "one step of the reduction of gains; below it another limit is active, and a richer recording "
    "would not help",
    "test_tune_unmodelled.py: the loop stays within the excited band",
)
MAX_DELAY_SHARE = Limit(
    0.5,
    "of the delay margin",
    "this additional delay leaves half of the phase margin; a loop that tolerates less than "
    "`delay_doubt` is not required to tolerate more",
    "test_tune_truth.py",
)
MAX_SETTLING_LOSS = Limit(
    0.1,
    "of a settling time",
    "cost: users notice several times the overshoot, but not a settling time that is a tenth "
    "longer",
    "test_tune_truth.py",
)

# Loops whose commands are reconstructed.
MAX_COMMAND_ERROR = Limit(
    1 / 255,
    "of the supply, rms",
    "one step of an 8-bit PWM, the resolution of a command",
    "test_known_loop.py: unknown commands are refused",
)
LOOP_RATE_TOLERANCE = Limit(
    0.02,
    "of the interval",
    "clocks of boards are within 2 %; a larger difference means that the log omits steps",
    "test_known_loop.py: unknown commands are refused",
)
TICK_TOLERANCE = Limit(
    0.05,
    "of a tick",
    "if 95 % of the speeds are this close to whole ticks, the number of ticks is certain",
    "test_known_loop.py: the command is reconstructed",
)

# A drive on new gains.
SETTLING_BAND = Limit(
    0.02,
    "of a change of set-point",
    "the field's usual band of a settling time",
    "test_verification.py: a wheel that does as designed",
)
MAX_PLANNED_OVERSHOOT = Limit(
    0.01,
    "of a change of set-point",
    "the largest planned overshoot of the reference; a load or a count may cause as much",
    "test_verification.py: a wheel that does as designed",
)
MAX_SILENCE = Limit(
    0.1,
    "s without a response",
    "half of wheel_pid's time-out: such a drive tests the computer, not the gains",
    "test_verification.py: a drive without control",
)
MAX_STEADY_ERROR = Limit(
    0.02,
    "of a change of set-point",
    "the same band: integral action leaves only the error that has not settled",
    "test_verification.py: a speed that stays off",
)
DRIVE_LEVEL = Limit(
    0.0005,
    "significance level of one reading",
    "four wheels have 24 readings in a drive: one sound drive in a hundred may be refused",
    "test_verification.py: a wheel that does as designed",
)
