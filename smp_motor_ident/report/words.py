"""Names, units and explanations in the reader's words."""

import math
from collections.abc import Mapping
from dataclasses import replace

from smp_motor_ident.finding import SEVERITIES, Finding
from smp_motor_ident.result import Estimate, Quantity

EXPLAINED: Mapping[str, tuple[str, str, str]] = {
    "resistance": ("R", "Resistance", "of the armature winding"),
    "inductance": ("L", "Inductance", "of the armature winding"),
    "motor_constant": ("K", "Motor constant", "torque per ampere, and back-EMF per rad/s"),
    "inertia": ("J", "Inertia", "of rotor and load, at the motor shaft"),
    "viscous_friction": ("b", "Viscous friction", "torque per rad/s"),
    "coulomb_friction": ("Tc", "Coulomb friction", "constant torque against the motion"),
    "coulomb_friction_reverse": ("Tc−", "Coulomb friction, reverse", "turning backwards"),
    "delay": ("τd", "Delay", "from voltage to speed, sensor filters included"),
    "dc_gain": ("k", "DC gain", "steady motor speed per volt beyond the static voltage"),
    "time_constant": ("τ", "Time constant", "how slowly the speed follows"),
    "time_constant_product": ("τ²", "Lag product", "of the electrical and mechanical lag"),
    "static_voltage": ("v0", "Static voltage", "needed to keep the motor barely turning"),
    "static_voltage_reverse": ("v0−", "Static voltage, reverse", "turning backwards"),
    "load_voltage": ("vl", "Load voltage", "offset that a constant load or sensor makes"),
    "averaging_window": ("w", "Averaging window", "over which the sensor averages the speed"),
    "sensor_lag": ("τs", "Sensor lag", "by which the speed's low-pass is late"),
    "dead_zone": ("vd", "Dead zone", "command for which the driver puts out nothing"),
    "clip_voltage": ("vc", "Clip voltage", "the most that the driver puts out"),
    "slew_rate": ("dv/dt", "Slew rate", "how fast the driver's voltage rises"),
    "source_resistance_ratio": ("ρ", "Source resistance", "of the supply, over the armature's"),
    "brush_drop": ("vb", "Brush drop", "over brushes or transistors, whatever the current"),
    "quadratic_drag": ("c", "Quadratic drag", "voltage that it takes, over back-EMF squared"),
    "current_limit_voltage": (
        "vi",
        "Current limit",
        "of the driver, times the resistance",
    ),
    "fast_decay_ratio": ("τₑf", "Fast-decay ratio", "electrical time constant in PWM periods"),
    "coasting_share": ("s₀", "Coasting share", "of back-EMF in the voltage at steady speed"),
    "current_lag": ("τi", "Current lag", "by which the current's sensor is late on average"),
}
"""Symbol, name and meaning of every quantity."""

MODELS: Mapping[str, str] = {
    "static_gain": "static gain: no lag that these data show",
    "first_order": "first order: one time constant",
    "second_order": "second order: electrical and mechanical lag",
    "electromechanical": "electromechanical: winding, rotor and friction",
}


def label(name: str) -> str:
    """Return a wheel, quantity or model in words."""
    if name in EXPLAINED:
        return EXPLAINED[name][1]
    return name.replace("_", " ").strip().capitalize()


def model(name: str) -> str:
    """Return a model's name in words."""
    return MODELS.get(name, name.replace("_", " "))


def number(value: float | None, std: float | None = None) -> str:
    """Return a number with the digits that its standard deviation supports.

    Examples
    --------
    >>> number(25.51832, 0.0123)
    '25.518'
    >>> number(1.13047e-6, 2e-9)
    '1.1305e-06'
    >>> number(None)
    '—'
    """
    if value is None or not math.isfinite(value):
        return "—"
    digits = 5
    if std is not None and std > 0 and value != 0:
        digits = 2 + math.floor(math.log10(abs(value))) - math.floor(math.log10(std))
        digits = min(max(digits, 2), 9)
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    places = digits - 1 - math.floor(math.log10(abs(value))) if value else 3
    return f"{value:.{max(places, 0)}f}"


def spread(std: float | None) -> str:
    """Return a standard deviation with two digits."""
    if std is None or not math.isfinite(std):
        return "—"
    if std == 0 or 1e-4 <= std < 1e3:
        return f"{std:.2g}"
    return f"{std:.1e}"


def interval(quantity: Quantity) -> str:
    """Return the 95 % interval of a number."""
    if quantity.ci95 is None:
        return "—"
    low, high = (number(bound, quantity.std) for bound in quantity.ci95)
    return f"{low} … {high}"


def systematic(quantity: Quantity) -> str:
    """Return the systematic uncertainties of a number, each with its cause.

    Examples
    --------
    >>> systematic(Quantity(12.9, 0.02, systematic=(Share("current_scale", 0.03, 0.39),)))
    '± 3 % (current scale)'
    """
    signs = {-1: "−", 0: "± ", 1: "+"}
    return ", ".join(
        signs[one.side]
        + (
            f"{100 * one.share:.2g} %"
            if one.share is not None
            else f"{spread(one.size)} {quantity.unit}"
        )
        + f" ({one.cause.replace('_', ' ')})"
        for one in quantity.systematic
    )


def typeset(unit: str) -> str:
    """Return a unit as one prints it."""
    return unit.replace("^2", "²").replace("ohm", "Ω")


def scaled(quantity: Quantity) -> Quantity:
    """Return a time in milliseconds, anything else as it is."""
    unit, factor = {"s": ("ms", 1e3), "s^2": ("ms²", 1e6)}.get(quantity.unit, (quantity.unit, 1.0))
    value, std = (None if one is None else one * factor for one in (quantity.value, quantity.std))
    ci95 = quantity.ci95 and (quantity.ci95[0] * factor, quantity.ci95[1] * factor)
    return replace(quantity, value=value, std=std, ci95=ci95, unit=unit)


def status(quantity: Quantity) -> str:
    """Return in words where a number comes from."""
    words = {"estimated": "estimated", "fixed": "given", "unidentifiable": "not identifiable"}
    return words[quantity.status]


def findings(estimate: Estimate) -> list[Finding]:
    """Return what was found, the gravest first."""
    return sorted(estimate.findings, key=lambda f: -SEVERITIES.index(f.severity))
