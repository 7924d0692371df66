# SPDX-License-Identifier: Apache-2.0
"""Thresholds for the motor's response by frequency."""

from smp_motor_ident.limits import Limit

BAND_LEVEL = Limit(
    0.05,
    "probability",
    "that the error of the response in a band lies outside of its circle, the level of the "
    "intervals of all stated numbers",
    "test_unmodelled.py: circle holds the error as often as it says",
)
BAND_WIDTH = Limit(
    10 ** (1 / 6),
    "last over first frequency of a band",
    "the damping of a shaft of 0.05 to 0.5 makes a resonance 0.1 to 1 of its frequency wide: it "
    "fills a quarter of a band or more",
    "test_unmodelled.py: resonance that the voltage excites is shown",
)
BAND_LINES = Limit(
    8,
    "lines of the spectrum",
    "some four independent ones: with fewer the circle exceeds its centre by chance",
    "test_unmodelled.py: circle holds the error as often as it says",
)
RESONANCE_DAMPING = Limit(
    0.05,
    "damping ratio",
    "physical: of a shaft of steel in its bearings; one with more damping is wide enough to show "
    "in the mean of its band",
    "test_unmodelled.py: resonance narrower than its band is shown by its peak",
)
