# SPDX-License-Identifier: Apache-2.0
"""Format numbers, names and messages, alike on the terminal and on pages."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone

from smp_motor_ident.finding import format_figure, format_power
from smp_motor_ident.result import QUANTITIES, Quantity

MODELS: Mapping[str, str] = {
    "static_gain": "static gain: no lag that these data show",
    "first_order": "first order: one time constant",
    "second_order": "second order: electrical and mechanical lag",
    "electromechanical": "electromechanical: winding, rotor and friction",
}


CAUSES: Mapping[str, str] = {
    "averaged_current": "current averaging",
    "averaged_speed": "speed averaging",
    "coast": "fast decay",
    "damping": "viscous share",
    "low_passed_current": "current low-pass",
    "low_passed_speed": "speed low-pass",
    "one_level": "one level of voltage",
    "prior_gain": "usual gains",
    "second_lag": "usual inductances",
    "slew": "slew limit",
    "smoothed_current": "current smoothing",
    "stribeck": "Stribeck",
}
"""Words for causes of systematic uncertainty that differ from their codes."""

SCALES = {"s": ("ms", 1e3), "s^2": ("ms^2", 1e6), "H": ("mH", 1e3), "N m": ("mN m", 1e3)}
"""Display units for small values, and their factors."""

MAX_DIGITS = 9  # largest number of digits, for simulations without noise


def label(name: str) -> str:
    """Return a wheel, quantity or model in words."""
    if name in QUANTITIES:
        return QUANTITIES[name][2]
    return name.replace("_", " ").strip().capitalize()


def label_in_sentence(name: str) -> str:
    """Return the name of a quantity within a sentence."""
    text = label(name)
    proper = text[:2].isupper() or text.startswith("Coulomb")
    return text if proper else text[0].lower() + text[1:]


def model(name: str) -> str:
    """Return a model's name in words."""
    return MODELS.get(name, name.replace("_", " "))


def spread(std: float) -> str:
    """Return a standard deviation with two digits."""
    return format_figure(float(f"{std:.2g}"), 2)


def state(quantity: Quantity, with_unit: bool = True) -> str:
    """Return a number with ± one standard deviation and unit, or else its possible range."""
    shown = scaled(quantity)
    if shown.value is None:
        text = interval(quantity)
    elif not shown.std:
        text = f"{shown.value:.6g}"
    else:
        text = _format_numbers(" ± ", (shown.value, shown.std), shown)
    return _append_unit(text, shown.unit) if with_unit and is_stated(quantity) else text


def interval(quantity: Quantity) -> str:
    """Return the 95 % interval of a number or its possible range, in the displayed unit."""
    shown = scaled(quantity)
    if shown.ci95 is None:
        return "—"
    if shown.value is None or not shown.std:
        return " … ".join(map(format_figure, shown.ci95))
    return _format_numbers(" … ", shown.ci95, shown)


def _format_numbers(between: str, values: Sequence[float], of: Quantity) -> str:
    """Return numbers with the decimals of a deviation's two digits, and their power of ten."""
    std, size = of.std or 0.0, max(abs(of.value or 0.0), of.std or 0.0)
    power = 0 if 1e-3 <= size < 1e6 else math.floor(math.log10(size))
    places = 1 - math.floor(math.log10(float(f"{std:.1e}"))) + power
    places = min(places, MAX_DIGITS - 1 - math.floor(math.log10(size)) + power)
    text = between.join(_format_fixed(value / 10.0**power, places) for value in values)
    return f"({text}){format_power(power)}" if power else text


def _format_fixed(value: float, places: int) -> str:
    """Return a number with so many decimals; a deviation too small for them with two digits."""
    rounded = round(value, places)
    return f"{rounded:.{max(places, 0)}f}" if rounded or not value else spread(value)


def _append_unit(text: str, unit: str) -> str:
    return text if unit in ("", "1") else f"{text} {format_unit(unit)}"


def systematic(quantity: Quantity) -> str:
    """Return the systematic uncertainties of a number, each with its cause."""
    shown = scaled(quantity)
    words = []
    for one in shown.systematic:
        unit = _append_unit(spread(one.size), shown.unit)
        size = f"{spread(100 * one.share)} %" if one.share is not None else unit
        words.append(f"± {size} ({cause(one.cause)})")
    volts = (quantity.valid or {}).get("voltage")
    return ", ".join([*words, *([f"observed at ±{volts[1]:.3g} V only"] if volts else [])])


def cause(name: str) -> str:
    """Return a cause of systematic uncertainty in words."""
    return CAUSES.get(name, name.replace("_", " "))


def format_unit(unit: str) -> str:
    """Return a unit in print."""
    return unit.replace("^2", "²").replace("ohm", "Ω")


def scaled(quantity: Quantity) -> Quantity:
    """Return a quantity in its display unit, such as a time in ms."""
    unit, factor = SCALES.get(quantity.unit, (quantity.unit, 1.0))
    value, std = (None if one is None else one * factor for one in (quantity.value, quantity.std))
    ci95 = quantity.ci95 and (quantity.ci95[0] * factor, quantity.ci95[1] * factor)
    shares = tuple(replace(one, size=one.size * factor) for one in quantity.systematic)
    return replace(quantity, value=value, std=std, ci95=ci95, unit=unit, systematic=shares)


def date(seconds: float) -> str:
    """Return a time since 1970 as a date."""
    return datetime.fromtimestamp(seconds, timezone.utc).strftime("%Y-%m-%d %H:%M UTC")


def is_stated(quantity: Quantity) -> bool:
    """Return whether a quantity has a number or a range."""
    return quantity.value is not None or quantity.ci95 is not None


def status(quantity: Quantity) -> str:
    """Return the status of a quantity in words."""
    words = {"estimated": "estimated", "fixed": "given", "unidentifiable": "not identifiable"}
    return words[quantity.status]


def to_sentence(text: str) -> str:
    """Return a message as a sentence, with the names of quantities in words."""
    known = {**QUANTITIES, **MODELS}
    text = re.sub(
        r"\b[a-z]+(_[a-z]+)+\b(?!=)",
        lambda m: label_in_sentence(m[0]) if m[0] in known else m[0],
        text.strip(),
    )
    text = re.sub(r"^[a-z]+(?=[ ,;])", lambda m: m[0].capitalize(), text)
    return text if not text or text[-1] in ".!?" else f"{text}."
