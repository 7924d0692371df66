# SPDX-License-Identifier: Apache-2.0
"""Every threshold of a decision about many robots, with its unit and its reason."""

from smp_motor_ident.limits import Limit

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
