# SPDX-License-Identifier: Apache-2.0
"""Convert an estimate to motors for the design, and draw uncertain ones."""

import math
from dataclasses import dataclass, field, fields, replace

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_control.motor.parameters import COMBINATIONS, PHYSICAL
from smp_motor_ident.errors import DesignError
from smp_motor_ident.finding import Finding
from smp_motor_ident.limits import MAX_FRICTION_ERROR, MAX_FRICTION_RANGE, MIN_UNRELIABLE_STD
from smp_motor_ident.result import Estimate, Quantity

SENSOR = ("delay", "averaging_window", "sensor_lag")
"""Delays between the motor's speed and the reported one, in s each."""


_POSITIVE = ("dc_gain", "time_constant", "resistance", "inductance", "motor_constant", "inertia")


@dataclass(frozen=True, eq=False)
class Motors:
    """Parameters of the response from voltage to reported speed, for a batch of motors."""

    # a0, a1, a2: shape (n,): coefficients [V s/rad], [V s^2/rad], [V s^3/rad] of ``a2 s^2 + a1 s +
    # a0``
    a0: Array
    a1: Array
    a2: Array
    delay: Array  # shape (n,), [s]: the motor's own delay, from applied voltage to reported speed
    static_voltage: Array  # shape (n,), [V]: Coulomb friction
    # shape (n,), [s]: over which the reported speed is averaged; 0 where none was identified
    averaging_window: Array = field(default_factory=lambda: np.zeros(1))
    # shape (n,), [s]: time constant of the filter of the reported speed
    sensor_lag: Array = field(default_factory=lambda: np.zeros(1))

    def __len__(self) -> int:
        """Return the number of motors."""
        return int(self.a0.size)

    def combine(self, k: int = 0) -> dict[str, float]:
        """Return the combinations and the delay of one motor."""
        shape, by = self.a0.shape, self.a0
        values = 1 / by, self.a1 / by, self.a2 / by, self.static_voltage, self.delay
        each = (float(np.broadcast_to(value, shape)[k]) for value in values)
        return dict(zip((*COMBINATIONS, "delay"), each))

    def first(self, n: int) -> "Motors":
        """Return the first ``n`` motors of the batch."""
        return Motors(**{each.name: getattr(self, each.name)[:n] for each in fields(self)})


@dataclass(frozen=True)
class Friction:
    """Range of dry friction, as a voltage."""

    known: float  # friction that the feed-forward compensates [V]
    # low, high: its range [V]
    low: float
    high: float
    finding: Finding | None = None  # where the range is wide or unknown

    @property
    def planned(self) -> float:
        """Voltage that the reference must keep in reserve [V]."""
        return self.known if self.finding is None else self.high


def bound_friction(estimate: Estimate, supply: float) -> Friction:
    """Return the range of dry friction, and the part that the feed-forward compensates."""
    quantity = _find_static_voltage(estimate)
    if quantity is None:
        words = "dry friction was not identified, so the integral alone compensates it"
        return Friction(0.0, 0.0, 0.0, Finding("friction_unknown", "warning", words))
    if quantity.value is None or not math.isfinite(quantity.std or 0.0):
        low, high = (0.0, supply) if quantity.ci95 is None else quantity.ci95
    elif (interval := quantity.total_ci95) is not None:
        low, high = interval
    else:
        half = 1.96 * (quantity.std or 0.0)
        low, high = quantity.value - half, quantity.value + half
    # The motor turned, so friction is below the supply.
    low, high = max(low, 0.0), high if quantity.total_std == 0.0 else min(high, supply)
    if high - low > MAX_FRICTION_RANGE * supply:
        raise DesignError(
            f"{estimate.wheel}: dry friction may be anything from {low:.3g} to {high:.3g} V of the "
            f"{supply:g} V supply, so only a combination of gain and friction is known; record the "
            "motor at two or more voltages in both directions, through standstill, and identify it "
            "again"
        )
    if high - low <= 2 * MAX_FRICTION_ERROR * supply and quantity.value is not None:
        return Friction(quantity.value, low, high)
    words = (
        f"dry friction is only known to lie between {low:.3g} and {high:.3g} V: the feed-forward "
        f"compensates {low:.3g} V, the integral the rest"
    )
    advice = "record voltages of both signs through standstill, slowly changing ones among them"
    evidence = {"low": low, "high": high}
    return Friction(low, low, high, Finding("friction_range", "warning", words, evidence, advice))


def _find_static_voltage(estimate: Estimate) -> Quantity | None:
    quantity = estimate.combinations.get("static_voltage")
    torque = estimate.parameters.get("coulomb_friction")
    if quantity is not None or torque is None or torque.value is None:
        return quantity
    per = estimate.value("resistance") / estimate.value("motor_constant", math.inf)
    return Quantity(per * torque.value, None if torque.std is None else per * torque.std)


def make_motors(estimate: Estimate) -> Motors:
    """Return the motor of an estimate, from its combinations or else its parameters."""
    return _convert(
        estimate, {name: np.array([estimate.value(name)]) for name in _list_names(estimate)}
    )


def draw_motors(
    estimate: Estimate, n: int, rng: np.random.Generator, friction: Friction | None = None
) -> Motors | None:
    """Draw motors from the distribution of the estimation error.

    Positive quantities are drawn log-normally, quantities that may be zero normally and clipped
    at zero.  The spread of an unreliable estimate is at least its unexplained share.  A second lag
    without a stated value is uniform over its range.
    """
    names = _list_names(estimate)
    mean = np.array([estimate.value(name) for name in names])
    covariance = _covariance(estimate, names, mean)
    wide = friction is not None and friction.high > friction.low
    hidden = _bound_hidden_lag(estimate)
    if not (np.any(np.diag(covariance) > 0) or wide or hidden):
        return None
    positive = np.array([name in _POSITIVE for name in names])
    scale = np.where(positive, np.where(positive, mean, 1.0), 1.0)
    relative = covariance / np.outer(scale, scale)
    # With this log-covariance the log-normal has the estimate's relative covariance.
    block = np.ix_(positive, positive)
    relative[block] = np.log1p(np.maximum(relative[block], -1 + 1e-12))
    centre = np.where(positive, -np.diag(relative) / 2, mean)
    draws = rng.multivariate_normal(centre, relative, n, method="eigh", check_valid="ignore").T
    values = {
        name: mean[k] * np.exp(draws[k]) if positive[k] else np.maximum(draws[k], 0.0)
        for k, name in enumerate(names)
    }
    if hidden and "dc_gain" in names:
        values["time_constant_product"] = rng.uniform(*hidden, n)
    motors = _convert(estimate, values)
    if friction is not None:
        static = np.clip(motors.static_voltage, friction.low, friction.high)
        if np.ptp(static) == 0.0 and wide:
            static = rng.uniform(friction.low, friction.high, n)
        motors = replace(motors, static_voltage=static)
    return motors


def _bound_hidden_lag(estimate: Estimate) -> tuple[float, float] | None:
    """Return the range of a product of lags [s^2] that has no stated value."""
    product = estimate.combinations.get("time_constant_product")
    if product is None or product.value is not None or product.ci95 is None:
        return None
    low, high = product.ci95
    return low, max(low, min(high, 0.25 * estimate.value("time_constant") ** 2))


def report_sensor_lag(estimate: Estimate) -> Finding | None:
    """Return a finding where the second lag may be the reported speed's filter."""
    causes = {s.cause for q in estimate.combinations.values() for s in q.systematic}
    if "low_passed_speed" not in causes:
        return None
    return Finding(
        "second_lag",
        "warning",
        "the second lag may belong to the motor or to a filter of the reported speed: the bands of "
        "the specification cover both",
        advice="record the encoder's counts",
    )


def compute_torque_noise(estimate: Estimate, sample_time: float) -> float:
    """Return the fluctuating load as an equivalent voltage over a sample [V rms].

    A model error larger than the response itself is a resonance and belongs to the bands of
    unmodelled dynamics.
    """
    error = estimate.residuals.model_error
    if error is not None and max(2 * s - b for s, b in zip(error.shown, error.bound)) > 1:
        return 0.0
    inertia = estimate.value("time_constant") / estimate.value("dc_gain", math.inf)
    load = inertia * estimate.evidence("torque_noise", "acceleration")
    return load / math.sqrt(sample_time)


def compute_outlier_share(estimate: Estimate) -> float:
    """Return the share of the reported speed's readings that were left out as outliers."""
    found = (f for f in estimate.findings if f.code == "glitches")
    return sum(float(f.evidence["samples"] or 0.0) for f in found) / max(estimate.samples, 1)


def move_lag_to_sensor(motors: Motors) -> Motors:
    """Return motors with the second lag as the reported speed's filter.

    The response from voltage to reported speed is the same; two lags that would be complex because
    of estimation errors are set equal.
    """
    total, product = motors.a1 / motors.a0, motors.a2 / motors.a0
    short = 0.5 * (total - np.sqrt(np.maximum(np.square(total) - 4 * product, 0.0)))
    return replace(
        motors,
        a1=motors.a0 * (total - short),
        a2=np.zeros_like(motors.a2),
        sensor_lag=motors.sensor_lag + short,
    )


def alternate_motors(motors: Motors, others: Motors) -> Motors:
    """Return a batch in which every other motor is one of ``others``."""
    other = np.arange(len(motors)) % 2 == 1
    pairs = ((f.name, getattr(motors, f.name), getattr(others, f.name)) for f in fields(motors))
    return Motors(**{name: np.where(other, b, a) for name, a, b in pairs})


def _covariance(estimate: Estimate, names: tuple[str, ...], mean: Array) -> Array:
    """Return the covariance of random and systematic errors, widened if unreliable."""
    covariance = np.zeros((len(names), len(names)))
    known = [k for k, name in enumerate(names) if name in estimate.names]
    index = [estimate.names.index(names[k]) for k in known]
    covariance[np.ix_(known, known)] = estimate.covariance[np.ix_(index, index)]
    for one in estimate.systematic:
        # `move_lag_to_sensor` draws which of the two lags is the motor's.
        if one.cause != "low_passed_speed":
            move = np.array([one.moves.get(name, 0.0) for name in names])
            covariance += np.outer(move, move)
    spread = np.zeros(len(names))
    if estimate.unreliable:
        spread[:] = unreliable_spread(estimate)
    covariance += np.diag((spread * mean) ** 2)
    return np.where(np.isfinite(covariance), covariance, 0.0)


def unreliable_spread(estimate: Estimate) -> float:
    """Return the relative standard deviation assumed for an unreliable estimate."""
    fit = estimate.fit_percent.validation
    unexplained = 1.0 if fit is None else 1.0 - fit / 100
    return min(max(MIN_UNRELIABLE_STD, unexplained), 0.5)


def _list_names(estimate: Estimate) -> tuple[str, ...]:
    if estimate.value("dc_gain") and estimate.value("time_constant"):
        return (*COMBINATIONS, *SENSOR)
    if all(estimate.value(n) for n in ("resistance", "motor_constant", "inertia")):
        return (*PHYSICAL, *SENSOR)
    grave = (f for f in estimate.findings if f.severity != "note" and f.advice)
    advice = "; ".join(f.advice for f in grave)
    raise DesignError(
        f"{estimate.wheel}: the estimate has neither DC gain and time constant nor all physical "
        "parameters, so no gains can be designed; "
        + (advice or "record two or more voltages in both directions and identify the motor again")
    )


def _convert(estimate: Estimate, value: dict[str, Array]) -> Motors:
    if "dc_gain" in value:
        a0 = 1 / value["dc_gain"]
        a1 = value["time_constant"] * a0
        a2 = value["time_constant_product"] * a0
        static = value["static_voltage"]
    else:
        R, L, K, J, b = (value[name] for name in PHYSICAL[:5])
        a0, a1, a2 = (R * b + K * K) / K, (R * J + L * b) / K, L * J / K
        static = R * value["coulomb_friction"] / K
    if not (np.all(a0 > 0) and np.all(a1 > 0) and np.all(a2 >= 0) and np.all(np.isfinite(a0))):
        raise DesignError(
            f"{estimate.wheel}: DC gain and time constant must be positive, they are "
            f"{1 / a0[0]:.4g} rad/s/V and {a1[0] / a0[0]:.4g} s"
        )
    sensor = (np.maximum(value[name], 0.0) for name in SENSOR)
    delay, window, lag = sensor
    # A low-pass of means lags by its time constant and half the window of each mean.
    lag = np.maximum(lag - 0.5 * window, 0.0)
    return Motors(a0, a1, a2, delay, np.abs(static), window, lag)
