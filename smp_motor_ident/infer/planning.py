# SPDX-License-Identifier: Apache-2.0
"""Plan the next recording: the excitation that brings every parameter to a wanted accuracy.

The Fisher information of a simulated recording predicts the accuracy before anything is recorded.
Derivation: docs/derivations.md, section 11.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.chain.chain import Chain
from smp_motor_ident.chain.motor import Electromechanical, Friction
from smp_motor_ident.chain.quantities import jacobian
from smp_motor_ident.chain.sensor import Angle, Current
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.fit.data import Data, prepare
from smp_motor_ident.fit.linear import invert, linearise
from smp_motor_ident.fit.noise import Noise
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.result import Estimate

AMPLITUDES = (0.4, 0.7, 1.0)
VISCOUS_SHARES = (0.03, 0.3, 0.7, 0.97)
"""Shares of a0 that viscous friction may be where the current was not measured."""
MAX_RESISTANCE_OHM = 15.0  # assumed where it is not known either
BAND_SPREADS = (0.5, 2.0, 6.0)
TRIAL_LENGTH_S = 10.0
UNKNOWN_ANGLE_STD = 0.01  # [rad], of an angle whose counts are not known


@dataclass(frozen=True)
class Proposal:
    """An excitation that would bring a quantity to a wanted accuracy."""

    amplitude: float  # [V]
    band: tuple[float, float]  # lowest and highest frequency [Hz] of a Fourier voltage
    duration: float  # [s]
    relative_std: Mapping[str, float]  # that it would leave, as a fraction of the value
    words: str  # the advice in one sentence


def what_next(
    estimate: Estimate,
    accuracy: float = 0.01,
    supply: float | None = None,
    longest: float = 600.0,
    current_noise: float = 0.01,
) -> Proposal:
    """Propose the shortest excitation that brings every parameter to a relative accuracy.

    Several amplitudes up to ``supply`` [V] (default: the robot's, or that of the recording) and
    bands are simulated with the estimated motor; the information of each grows in proportion to its
    length, of at most ``longest`` [s].  Where the current was not measured, the prediction holds
    for the least favourable motor of the same response, and a current with ``current_noise`` [A].
    """
    limit = supply or estimate.hardware.supply_voltage or estimate.largest_voltage
    if not limit:
        raise ParameterError(
            f"{estimate.wheel}: neither the supply nor the voltage of the recording is known; "
            "give the largest voltage that the motor may get"
        )
    family = _list_equivalent_motors(estimate)
    step = estimate.sample_time or 0.005
    corner = 1 / (2 * np.pi * max(estimate.value("time_constant"), 4 * step))
    needs_current = not estimate.model.startswith("electromechanical")
    best: Proposal | None = None
    for share in AMPLITUDES:
        for spread in BAND_SPREADS:
            band = (max(0.05, 0.1 * corner), min(corner * spread, 0.4 / step))
            data = _make_trial(share * limit, band, step, estimate.hardware)
            each = [_predict_relative_std(data, chain, estimate, current_noise) for chain in family]
            relative = {n: max(one[n] for one in each) for n in each[0]}
            length = TRIAL_LENGTH_S * (max(relative.values()) / accuracy) ** 2
            duration = float(np.clip(length, 5.0, longest))
            after = {n: v * float(np.sqrt(TRIAL_LENGTH_S / duration)) for n, v in relative.items()}
            words = _describe_proposal(
                share * limit, band, duration, needs_current, after, accuracy
            )
            made = Proposal(share * limit, band, duration, after, words)
            if best is None or _rank_proposal(made, accuracy) < _rank_proposal(best, accuracy):
                best = made
    assert best is not None
    return best


def _rank_proposal(p: Proposal, accuracy: float) -> tuple[float, float, float]:
    # A length that suffices misses by rounding only, which must not choose.
    excess = round(max(0.0, max(p.relative_std.values()) / accuracy - 1.0), 9)
    return excess, p.duration, p.amplitude


def _list_equivalent_motors(estimate: Estimate) -> list[Chain]:
    """Return the motors with the same response as the estimated one."""
    resistance = estimate.value("resistance") or estimate.hardware.resistance or MAX_RESISTANCE_OHM
    gain, lag = estimate.value("dc_gain"), estimate.value("time_constant")
    product = estimate.value("time_constant_product") or 0.02 * lag**2
    values = {
        "ln_a0": -np.log(gain), "ln_a1": np.log(lag / gain), "ln_a2": np.log(product / gain),
        "vc": estimate.value("static_voltage"), "ln_r": np.log(resistance), "current_offset": 0.0,
    }  # fmt: skip
    known = estimate.chain.values.get("viscous") if estimate.value("resistance") else None
    shares = VISCOUS_SHARES if known is None else (known,)
    made = (Electromechanical(), Friction(), Angle(), Current())
    return [Chain(made, {**values, "viscous": share}) for share in shares]


def _make_trial(
    amplitude: float, band: tuple[float, float], step: float, hardware: Hardware
) -> Data:
    t = np.arange(int(TRIAL_LENGTH_S / step), dtype=np.float64) * step
    tones = np.geomspace(*band, 16) * (1 + 0.013 * np.sin(np.arange(16) * 2.399))
    phases = np.pi * np.arange(16) ** 2 / 16
    v = np.cos(2 * np.pi * np.outer(t, tones) + phases).sum(axis=1)
    v *= amplitude / np.abs(v).max()
    still = np.zeros(len(t))
    record = Record("trial", t, v, still, None, still, hardware=hardware)
    data = prepare([record], True)
    return replace(data, starts_at_rest=np.ones(1, dtype=np.bool_))


def _predict_relative_std(
    data: Data, chain: Chain, estimate: Estimate, current_noise: float
) -> dict[str, float]:
    """Return the relative standard deviation of every physical parameter after a trial."""
    turn = estimate.hardware.counts_per_revolution
    noise = (
        Noise.white(2 * np.pi / turn / np.sqrt(12) if turn else UNKNOWN_ANGLE_STD),
        Noise.white(current_noise),
    )
    scales = data.scales(estimate.value("time_constant"))
    linear = linearise(data, chain, scales, np.zeros((1, 4)), noise)
    columns = linear.columns[: linear.data.row.size]
    values, rows = jacobian(chain)
    spread = np.diag(rows @ invert(columns.T @ columns) @ rows.T)
    std = dict(zip(values, np.sqrt(np.maximum(spread, 0.0)), strict=True))
    out = {}
    for name in PHYSICAL:
        if name == "coulomb_friction" and not chain.values["vc"]:
            continue
        scale = abs(values[name]) or 1.0
        if name == "viscous_friction":  # often hardly any: against what turns the motor
            scale = max(scale, 0.05 * values["motor_constant"] ** 2 / values["resistance"])
        out[name] = float(std[name] / scale)
    return out


def _describe_proposal(
    amplitude: float,
    band: tuple[float, float],
    duration: float,
    needs_current: bool,
    after: Mapping[str, float],
    accuracy: float,
) -> str:
    worst = max(after, key=lambda n: after[n])
    name = worst.replace("_", " ")
    reached = "every parameter" if after[worst] <= 1.001 * accuracy else f"all but {name}"
    return (
        f"record {duration:.0f} s of a Fourier voltage of {amplitude:.3g} V peak with tones from "
        f"{band[0]:.2g} to {band[1]:.2g} Hz in both directions"
        + (", with the motor current measured" if needs_current else "")
        + f": {reached} would be known within {100 * accuracy:.2f} % "
        f"({name} to {100 * after[worst]:.2f} %)"
    )
