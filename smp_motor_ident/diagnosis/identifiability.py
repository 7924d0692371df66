"""What the data can and cannot tell, and what to record next.

Certainty against value, from the Fisher information of the fitted model, which also tells, before
anything is recorded, what an excitation would teach.
Derivation: docs/derivations.md, section 11.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from smp_motor_control.motor.parameters import PHYSICAL
from smp_motor_ident.errors import ParameterError
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.likelihood.noise import NO_GAIN
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.physical import physical_gradients
from smp_motor_ident.model.structures import Electromechanical
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.result import Estimate

AMPLITUDES = (0.4, 0.7, 1.0)
SHARES = (0.97, 0.7, 0.3, 0.03)  # of a0 that K may be, where the current was not measured
LARGEST_RESISTANCE = 15.0  # [ohm] allowed for where it is not known either
SPREADS = (0.5, 2.0, 6.0)
TRIAL = 10.0


@dataclass(frozen=True)
class Proposal:
    """An excitation that would bring a quantity to a wanted accuracy."""

    amplitude: float  # [V]
    # Lowest and highest frequency [Hz] of a Fourier voltage with incommensurate tones
    band: tuple[float, float]
    duration: float  # [s]
    relative_std: Mapping[str, float]  # what it would leave uncertain, as a fraction of the value
    measure_current: bool  # whether the current must be recorded for it
    words: str  # the advice in one sentence


def what_next(
    estimate: Estimate,
    accuracy: float = 0.01,
    supply: float | None = None,
    longest: float = 600.0,
    current_noise: float = 0.01,
) -> Proposal:
    """Propose the excitation that would bring every parameter to a wanted accuracy.

    Several amplitudes and bands are simulated with the estimated motor; the Fisher
    information of each, which grows in proportion to the length, tells how long it must be.
    Where the current was not measured a family of motors answers the same: the prediction holds
    for the least favourable of them whose back-EMF is at least 3 % of what limits the speed.
    """
    limit = supply or estimate.hardware.supply_voltage or estimate.largest_voltage
    if not limit:
        raise ParameterError(
            f"{estimate.wheel}: neither the supply nor the voltage of the recording is known; "
            "give the largest voltage that the motor may get"
        )
    family, needs_current = _family(estimate, current_noise)
    step = estimate.sample_time or 0.005
    corner = 1 / (2 * np.pi * max(estimate.value("time_constant"), 4 * step))
    best: Proposal | None = None
    for share in AMPLITUDES:
        for spread in SPREADS:
            band = (max(0.05, 0.1 * corner), min(corner * spread, 0.4 / step))
            record = _trial(share * limit, band, step, estimate.hardware)
            each = [_relative_std(record, fit) for fit in family]
            relative = {n: max(one[n] for one in each) for n in each[0]}  # the least certain
            length = TRIAL * (max(relative.values()) / accuracy) ** 2
            duration = float(np.clip(length, 5.0, longest))
            after = {n: v * float(np.sqrt(TRIAL / duration)) for n, v in relative.items()}
            words = _words(share * limit, band, duration, needs_current, after, accuracy)
            made = Proposal(share * limit, band, duration, after, needs_current, words)
            if best is None or _cost(made, accuracy) < _cost(best, accuracy):
                best = made
    assert best is not None
    return best


def _cost(p: Proposal, accuracy: float) -> tuple[float, float, float]:
    # What is long enough misses nothing but by rounding, which must not choose.
    excess = round(max(0.0, max(p.relative_std.values()) / accuracy - 1.0), 9)
    return (excess, p.duration, p.amplitude)


def _family(estimate: Estimate, current_noise: float) -> tuple[list[Fit], bool]:
    """Return the motors that answer as the estimated one does, and whether current is lacking."""
    known = {n: q.value for n, q in estimate.parameters.items() if n in PHYSICAL}
    given = known.get("resistance") or estimate.hardware.resistance
    r = given or LARGEST_RESISTANCE
    gain, tau = estimate.value("dc_gain"), estimate.value("time_constant")
    product = estimate.value("time_constant_product") or 0.02 * tau**2
    a0, a1, a2 = 1 / gain, tau / gain, product / gain
    z = Coordinates(np.log(a0), np.log(a1), np.log(a2), ln_r=np.log(r))
    z = z.with_friction(estimate.value("static_voltage"))
    structure = Electromechanical("symmetric" if z.vc_plus > 0 else "none")
    turn = estimate.hardware.counts_per_revolution
    noise = np.diag([(2 * np.pi / turn) ** 2 / 12 if turn else 1e-4, current_noise**2])
    f = len(structure.free)
    fits = []
    for te in _electric(estimate, z):
        fits.append(
            Fit(z.with_(ln_te=np.log(te)), np.zeros((1, 5)), noise, structure=structure,
                gain=NO_GAIN, objective=0.0,
                deviance=0.0, information=np.eye(f), scores=np.zeros((0, f)), passes=0,
                converged=True, samples=0, kind=ANGLE)
        )  # fmt: skip
    return fits, not estimate.model.startswith("electromechanical")


def _electric(estimate: Estimate, z: Coordinates) -> list[float]:
    """Return L/R, or the values of it that the response leaves open: be = a1/te - a2/te^2."""
    inductance, r = estimate.value("inductance"), estimate.value("resistance")
    if inductance > 0 and r > 0:
        return [inductance / r]
    out = []
    for share in SHARES:
        roots = np.roots([(1 - share) * z.a0, -z.a1, z.a2])
        real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
        out += [float(te) for te in real if te > 0]
    return out or [1.1 * z.second_lag]


def _trial(amplitude: float, band: tuple[float, float], step: float, hardware: Hardware) -> Record:
    t = np.arange(int(TRIAL / step), dtype=np.float64) * step
    tones = np.geomspace(*band, 16) * (1 + 0.013 * np.sin(np.arange(16) * 2.399))
    phases = np.pi * np.arange(16) ** 2 / 16
    v = np.cos(2 * np.pi * np.outer(t, tones) + phases).sum(axis=1)
    v *= amplitude / np.abs(v).max()
    return Record("trial", t, v, np.zeros(len(t)), None, np.zeros(len(t)), hardware=hardware)


def _relative_std(record: Record, fit: Fit) -> dict[str, float]:
    data = replace(prepare([record], True), kind=ANGLE)
    information = prediction.information(data, fit)
    cov = replace(fit, information=information).covariance()
    known = physical_gradients(fit.z)
    matrix = fit.structure.matrix
    out = {}
    for name in PHYSICAL:
        if name == "coulomb_friction" and fit.structure.friction == "none":
            continue
        value, gradient = known[name]
        row, scale = gradient @ matrix, abs(value) or 1.0
        if name == "viscous_friction":  # often next to nothing: against what turns the motor
            scale = max(scale, 0.05 * known["motor_constant"][0] ** 2 / known["resistance"][0])
        out[name] = float(np.sqrt(row @ cov @ row) / scale)
    return out


def _words(
    amplitude: float,
    band: tuple[float, float],
    duration: float,
    needs_current: bool,
    after: Mapping[str, float],
    accuracy: float,
) -> str:
    worst = max(after, key=lambda n: after[n])
    reached = "every parameter" if after[worst] <= 1.001 * accuracy else f"all but {worst}"
    return (
        f"record {duration:.0f} s of a Fourier voltage of {amplitude:.3g} V peak with tones from "
        f"{band[0]:.2g} to {band[1]:.2g} Hz in both directions"
        + (", with the motor current measured" if needs_current else "")
        + f": {reached} would be known within {accuracy:.2%} ({worst} to {after[worst]:.2%})"
    )
