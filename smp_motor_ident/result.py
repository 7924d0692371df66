# SPDX-License-Identifier: Apache-2.0
"""Define the result of an estimation: values with uncertainty, status and reasons.

Plain data, written to and read from ``identification.json`` without loss.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import msgspec
import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.finding import Finding, gravest
from smp_motor_ident.record import Hardware, NotNegative

Status = Literal["estimated", "fixed", "unidentifiable"]

NORMAL_95 = 1.959964  # half the 95 % interval of a normal distribution, in standard deviations

QUANTITIES: Mapping[str, tuple[str, str, str, str]] = {
    "resistance": ("ohm", "R", "Resistance", "of the armature winding"),
    "inductance": ("H", "L", "Inductance", "of the armature winding"),
    "motor_constant": ("N m/A", "K", "Motor constant", "torque per ampere, and back-EMF per rad/s"),
    "inertia": ("kg m^2", "J", "Inertia", "of rotor and load, at the motor shaft"),
    "viscous_friction": ("N m s/rad", "b", "Viscous friction", "torque per rad/s"),
    "coulomb_friction": ("N m", "Tc", "Coulomb friction", "constant torque against the motion"),
    "coulomb_friction_reverse": ("N m", "Tc−", "Coulomb friction, reverse", "turning backwards"),
    "delay": ("s", "τd", "Delay", "from voltage to speed, sensor filters included"),
    "dc_gain": ("rad/s/V", "k", "DC gain", "steady motor speed per volt beyond the static voltage"),
    "time_constant": ("s", "τ", "Time constant", "sum of the lags from voltage to speed"),
    "time_constant_product": ("s^2", "τ₁τ₂", "Lag product", "of the two time constants"),
    "static_voltage": ("V", "v0", "Static voltage", "voltage that overcomes Coulomb friction"),
    "static_voltage_reverse": ("V", "v0−", "Static voltage, reverse", "turning backwards"),
    "load_voltage": ("V", "vl", "Load voltage", "voltage that a constant load takes"),
    "steady_speed": ("rad/s", "ω∞", "Steady speed", "at the one voltage that was recorded"),
    "averaging_window": ("s", "w", "Averaging window", "over which the sensor averages the speed"),
    "sensor_lag": ("s", "τs", "Sensor lag", "of the speed's low-pass"),
    "current_lag": ("s", "τi", "Current lag", "mean lag of the current sensor"),
    "encoder_error": ("rad", "e", "Encoder error", "amplitude of its error once a turn"),
    "dead_zone": ("V", "vd", "Dead zone", "voltage that the driver subtracts from every command"),
    "least_command": ("V", "vm", "Least command", "size below which the driver ignores a command"),
    "clip_voltage": ("V", "vc", "Clip voltage", "largest voltage of the driver"),
    "slew_rate": ("V/s", "dv/dt", "Slew rate", "largest rate of the driver's voltage"),
    "source_resistance_ratio":
        ("1", "ρ", "Source resistance", "of the supply, over the armature's"),
    "brush_drop": ("V", "vb", "Brush drop", "over brushes or transistors, whatever the current"),
    "current_limit_voltage": ("V", "vi", "Current limit", "of the driver, times the resistance"),
    "quadratic_drag":
        ("1/V", "c", "Quadratic drag", "voltage of the drag over the square of the back-EMF"),
    "fast_decay_ratio": ("1", "τₑf", "Fast-decay ratio", "electrical time constant in PWM periods"),
    "coasting_share":
        ("1", "s₀", "Coasting share", "share of back-EMF in the voltage at steady speed"),
}  # fmt: skip
"""Unit, symbol, name and meaning of every quantity, at the motor shaft."""
UNITS = {name: unit for name, (unit, *_) in QUANTITIES.items()}


@dataclass(frozen=True)
class Share:
    """A systematic uncertainty of one number, common to all recordings and invisible in them.

    Attributes
    ----------
    cause : str
        Code of the finding that explains it, such as ``current_scale``.
    share : float or None
        Its standard deviation relative to the number; None where the number is zero.
    size : float
        Its standard deviation in the number's unit.
    """

    cause: str
    share: NotNegative | None
    size: NotNegative


@dataclass(frozen=True)
class Quantity:
    """One estimated number.

    Attributes
    ----------
    value : float or None
        None where the data do not determine it.
    std : float or None
        Random standard deviation, the scatter between recordings of the same motor; None where
        value is None or the user fixed it.
    ci95 : tuple of float or None
        95 % confidence interval of the random uncertainty; of an unidentifiable combination the
        range that the data leave open.
    unit : str
        SI unit.
    status : {'estimated', 'fixed', 'unidentifiable'}
        Origin of the number.
    systematic : tuple of Share
        Uncertainties that no recording shows; never part of ``std`` and ``ci95``.
    valid : mapping of str to (float, float), optional
        Operating points at which the number was observed, such as ``voltage`` [V]; None if it also
        holds elsewhere.
    """

    value: float | None
    std: NotNegative | None = None
    ci95: tuple[float, float] | None = None
    unit: str = ""
    status: Status = "estimated"
    systematic: tuple[Share, ...] = ()
    valid: Mapping[str, tuple[float, float]] | None = None

    @property
    def total_std(self) -> float:
        """Standard deviation of random and systematic uncertainty together, in ``unit``."""
        return math.hypot(self.std or 0.0, *(one.size for one in self.systematic))

    @property
    def total_ci95(self) -> tuple[float, float] | None:
        """95 % interval of random and systematic uncertainty together, in ``unit``."""
        if self.ci95 is None or self.value is None:
            return self.ci95
        sizes = [NORMAL_95 * s.size for s in self.systematic]
        low, high = (math.hypot(end - self.value, *sizes) for end in self.ci95)
        return self.value - low, self.value + high


@dataclass(frozen=True)
class FitPercent:
    """Normalised fit ``100 (1 - |y - yhat| / |y - mean y|)`` of the simulated speed."""

    estimation: float | None = None
    validation: float | None = None


@dataclass(frozen=True)
class Candidate:
    """A candidate structure and its fit."""

    model: str
    fit_percent: float | None
    bic: float | None
    chosen: bool = False
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation over lags [samples], with the simultaneous 95 % band of white residuals."""

    lag: Array
    value: Array
    band: float


@dataclass(frozen=True)
class ModelError:
    """Error of the model's response relative to that response, band by band."""

    frequency: tuple[float, ...]  # middles of the bands [rad/s], rising
    # shown, bound: estimated magnitude, and its upper 95 % bound [-]
    shown: tuple[float, ...]
    bound: tuple[float, ...]


@dataclass(frozen=True)
class ResidualTests:
    """Whiteness of the residuals, independence of the input (95 % bands), error by frequency."""

    white: bool | None = None
    independent_of_input: bool | None = None
    autocorrelation: Correlation | None = field(default=None, compare=False, repr=False)
    cross_correlation: Correlation | None = field(default=None, compare=False, repr=False)
    model_error: ModelError | None = None


@dataclass(frozen=True)
class ChainRecord:
    """The chain that produced the recordings: codes of its components, values of its parameters."""

    components: tuple[str, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Systematic:
    """A systematic error and its effect on every number.

    Attributes
    ----------
    cause : str
        Code of the finding that explains it, such as ``current_scale``.
    share : float
        Its standard deviation, relative.
    moves : mapping of str to float
        Change of each number by one standard deviation of it, in the number's own unit.
    """

    cause: str
    share: float
    moves: Mapping[str, float]


@dataclass(frozen=True)
class Estimate:
    """The answer for one motor; keys and meanings of ``identification.json``.

    Attributes
    ----------
    wheel, model : str
        Name of the wheel, and of the candidate structure that was chosen.
    parameters : mapping of str to Quantity
        Physical parameters at the motor shaft, with ``unidentifiable`` ones listed as such.
    combinations : mapping of str to Quantity
        Quantities from voltage and speed alone: ``dc_gain``, ``time_constant``,
        ``time_constant_product``, ``static_voltage``, ``delay`` if the model has them;
        ``steady_speed`` at one voltage (in the finding ``one_level``) where that alone is known.
    names : tuple of str
        Quantities that ``covariance`` is about, in its order.
    covariance : ndarray, shape (p, p)
        Covariance of the estimation error of ``names``, in their own units squared.
    speed_noise : float
        Standard deviation [rad/s] of the noise on the fitted speed; 0 for a fit to an angle.
    speed_step : float
        Resolution [rad/s] of that speed; 0 without steps, or for an angle.
    angle_noise : float
        Standard deviation [rad] of the noise on the recorded angle, or on the angle whose
        difference is the recorded speed; 0 for counts, whose quantisation is known, and for other
        speeds.
    systematic : tuple of Systematic
        Errors that no recording shows; not part of ``std``, ``ci95`` and ``covariance``.
    chain : ChainRecord
        Components between command and recording, with their values.
    """

    wheel: str
    model: str
    parameters: Mapping[str, Quantity]
    combinations: Mapping[str, Quantity]
    names: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    fit_percent: FitPercent = FitPercent()
    candidates: tuple[Candidate, ...] = ()
    residuals: ResidualTests = ResidualTests()
    findings: tuple[Finding, ...] = ()
    samples: int = 0
    duration: float = 0.0
    sample_time: NotNegative = 0.0
    speed_noise: NotNegative = 0.0
    speed_step: NotNegative = 0.0
    angle_noise: NotNegative = 0.0
    largest_voltage: float = 0.0
    sources: tuple[str, ...] = ()
    hardware: Hardware = Hardware()
    systematic: tuple[Systematic, ...] = ()
    chain: ChainRecord = ChainRecord()

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Parameters that the data do not determine."""
        return tuple(n for n, q in self.parameters.items() if q.status == "unidentifiable")

    @property
    def warnings(self) -> tuple[str, ...]:
        """Messages of the findings that are more than notes."""
        return tuple(dict.fromkeys(f.message for f in self.findings if f.severity != "note"))

    @property
    def advice(self) -> tuple[str, ...]:
        """Advice of the findings."""
        return tuple(dict.fromkeys(f.advice for f in self.findings if f.advice))

    @property
    def unreliable(self) -> bool:
        """Whether a stated number may be off by more than its interval."""
        return gravest(self.findings) in ("unreliable", "refused")

    @property
    def identifiable(self) -> bool:
        """Whether every parameter of the model is identifiable."""
        return not self.unidentifiable

    def value(self, name: str, default: float = 0.0) -> float:
        """Return a parameter or combination in its unit, ``default`` where it has no value."""
        quantity = self.combinations.get(name) or self.parameters.get(name)
        return default if quantity is None or quantity.value is None else quantity.value

    def evidence(self, code: str, name: str) -> float:
        """Return the largest evidence ``name`` in the findings of a code, 0 without one."""
        found = (f.evidence.get(name) for f in self.findings if f.code == code)
        return max((float(x) for x in found if isinstance(x, int | float)), default=0.0)

    def to_document(self) -> dict[str, Any]:
        """Return the motor's entry of ``identification.json``, of plain types."""
        document: dict[str, Any] = {name: getattr(self, name) for name in _WRITTEN}
        document["covariance"] = {"names": self.names, "matrix": self.covariance}
        document["residuals"] = {
            "white": self.residuals.white,
            "independent_of_input": self.residuals.independent_of_input,
            "model_error": self.residuals.model_error,
        }
        return dict(plain(document))


_WRITTEN = (
    "model", "chain", "parameters", "identifiable", "unidentifiable", "combinations", "covariance",
    "systematic", "fit_percent", "candidates", "residuals", "findings",
    "warnings", "advice", "samples", "duration", "sample_time", "speed_noise", "speed_step",
    "angle_noise", "largest_voltage", "sources", "hardware",
)  # fmt: skip
"""Fields of an estimate in ``identification.json``."""


def plain(value: Any) -> Any:
    """Return data classes and arrays as plain JSON types; NaN and infinity become None."""
    text = msgspec.json.encode(value, enc_hook=lambda numbers: numbers.tolist())
    return msgspec.json.decode(text)


def to_json(document: Mapping[str, Any]) -> str:
    """Return a document as the text of a file."""
    return json.dumps(plain(document), indent=2) + "\n"
