"""An estimated motor, driven by a recorded voltage: what it would have done."""

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.validation import percent
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.coordinates import NAMES, Coordinates
from smp_motor_ident.model.measurement import ANGLE, SPEED
from smp_motor_ident.model.static_gain import INSTANTLY
from smp_motor_ident.model.structures import FirstOrder, SecondOrder, StaticGain
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate


def simulate(estimate: Estimate, record: Record) -> tuple[Array, Array]:
    """Return the measured and the freely simulated speed of a recording.

    Only the state at the beginning of each segment is fitted; from there on the motor sees
    nothing but the voltage.
    """
    fit = _motor(estimate)
    data = prepare([record], False).measured_as(fit.kind)
    settled = prediction.settle(data, fit)
    predicted = prediction.simulate(data, settled)
    if data.kind != ANGLE:
        return data.output, predicted[:, 1]
    mean = _differences(record, predicted[:, 1])
    measured = record.velocity
    if measured is None:
        return _differences(record, data.output), mean
    at_once = predicted[:, 0]
    better = percent(measured, at_once) > percent(measured, mean)
    return measured, at_once if better else mean


def _differences(record: Record, angle: Array) -> Array:
    speed = np.diff(angle, prepend=np.nan) / np.diff(record.time, prepend=np.nan)
    speed[list(record.starts)] = np.nan
    return np.asarray(speed)


def _motor(estimate: Estimate) -> Fit:
    """Return the estimate as a fit with nothing free."""
    z = coordinates(estimate)
    fixed = {n: z.value(n) for n in NAMES}
    instant = estimate.model.startswith("static_gain")
    second = estimate.value("time_constant_product") > 0
    kind = SecondOrder if second else StaticGain if instant else FirstOrder
    filtered = estimate.value("sensor_lag") > 0
    ticks = int(estimate.evidence("low_passed_speed", "samples_per_row"))
    mean = estimate.value("averaging_window") if filtered else 0.0
    structure = kind("asymmetric", low_pass=filtered, ticks=ticks, mean=mean, fixed=fixed)
    nothing = np.zeros((0, 0))
    return Fit(
        structure=structure,
        z=z,
        initial=np.zeros((1, 5)),
        noise=np.eye(2),
        noise_ratio=0.0,
        gain=np.zeros((3, 2)),
        objective=0.0,
        deviance=0.0,
        information=nothing,
        scores=nothing,
        passes=0,
        converged=True,
        samples=estimate.samples,
        kind=structure.speed if z.window > 0 else SPEED,
    )


def coordinates(estimate: Estimate) -> Coordinates:
    """Return an estimate in the coordinates of the fit."""
    ln_a0 = -float(np.log(estimate.value("dc_gain") or _gain_without_friction(estimate)))
    lag, product = estimate.value("time_constant"), estimate.value("time_constant_product")
    forward = estimate.value("static_voltage")
    z = Coordinates(
        ln_a0=ln_a0,
        ln_a1=ln_a0 + (float(np.log(lag)) if lag > 0 else INSTANTLY),
        vc_plus=forward,
        vc_minus=estimate.value("static_voltage_reverse", forward),
        load=estimate.value("load_voltage"),
        delay=estimate.value("delay"),
        window=2 * estimate.value("sensor_lag") or estimate.value("averaging_window"),
    )
    if not product > 0:
        return z
    z = z.with_(ln_a2=ln_a0 + np.log(product)).undamped()
    inductance, resistance = estimate.value("inductance"), estimate.value("resistance")
    known = inductance > 0 and resistance > 0
    return z.with_(ln_te=np.log(inductance / resistance)) if known else z


def _gain_without_friction(estimate: Estimate) -> float:
    """Return the gain that moves the motor alike at the one level of which it is known."""
    level = estimate.evidence("one_level", "voltage")
    return estimate.value("steady_speed") / level if level else 0.0
