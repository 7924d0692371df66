# SPDX-License-Identifier: Apache-2.0
"""Default accuracies of instruments and drivers.

Printed with the others in ``docs/limits.md``.
"""

from smp_motor_ident.limits import Limit

CURRENT_ACCURACY = Limit(
    0.03,
    "of the current's scale, a standard deviation",
    "physical: a Hall sensor's sensitivity is sold to 4 % (ACS712, 96 to 104 mV/A) and follows a "
    "supply of 5 V that is known to as much: 5 % either way, uniformly",
    "test_limits_hold.py: scale error of a current is within the systematic uncertainty",
)
TIMING_ACCURACY = Limit(
    0.02,
    "rows between stamp and reading, a standard deviation",
    "physical: a loop computes for some hundredths of its period before it commands",
    "test_limits_hold.py: instant of a reading is within the systematic uncertainty",
)
ONE_SIZE_ACCURACY = Limit(
    0.1,
    "of gain and lag, a standard deviation",
    "physical: a bipolar bridge drops some 2 V of 12, so that the gain at half the voltage is less "
    "by about as much; of one size of voltage nothing shows it",
    "test_limits_hold.py: gain at one amplitude is sharp and states where it holds",
)
