# SPDX-License-Identifier: Apache-2.0
"""The motors of the paper's Table 1."""

from smp_motor_control.motor import MotorParameters

TABLE_1 = {
    "front_left": (12.919, 0.30994, 0.011029, 1.13e-6, 2.40e-5),
    "front_right": (4.5516, 0.06754, 0.001761, 6.60e-7, 2.23e-5),
    "rear_left": (3.2843, 0.06383, 0.030117, 1.40e-5, 5.53e-5),
    "rear_right": (2.7031, 0.03995, 0.035314, 2.21e-5, 6.45e-5),
}
"""R [ohm], L [H], K [V s/rad], J [kg m^2], b [N m s/rad]."""


def combinations_of(p):
    """Return the parameter combinations identifiable from voltage and speed."""
    names = ("dc_gain", "time_constant", "time_constant_product", "static_voltage")
    return {name: getattr(p, name) for name in names}


def paper_motor(wheel, static_voltage=0.0, inductance=None):
    """Return a motor of the table with Coulomb friction, perhaps with another inductance."""
    R, L, K, J, b = TABLE_1[wheel]
    return MotorParameters(
        resistance=R, inductance=L if inductance is None else inductance, motor_constant=K,
        inertia=J, viscous_friction=b, coulomb_friction=static_voltage * K / R,
    )  # fmt: skip
