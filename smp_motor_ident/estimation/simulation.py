"""An estimated motor, driven by a recorded voltage: what it would have done."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smp_motor_ident.diagnosis.validation import percent
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood import recursion as rc
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model import structures as models
from smp_motor_ident.model.structures import Structure
from smp_motor_ident.record import Record
from smp_motor_ident.result import Estimate

Array = NDArray[np.float64]


def simulate(estimate: Estimate, record: Record) -> tuple[Array, Array]:
    """Return the measured and the freely simulated speed of a recording.

    Only the state at the beginning of each segment is fitted; from there on the motor sees
    nothing but the voltage.
    """
    data = prepare([record], False)
    fit = _motor(estimate)
    if fit.structure.fixed["window"] > 0 and data.kind == rc.SPEED:
        data = data.as_mean_speed()
    settled = prediction.settle(data, fit)
    predicted = prediction.simulate(data, settled)
    if data.kind != rc.ANGLE:
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
    z, order = coordinates(estimate)
    fixed = dict(zip(models.Z_NAMES, map(float, z), strict=True))
    name = "static_gain" if estimate.model.startswith("static_gain") else "estimated"
    structure = Structure(name, order, "asymmetric", fixed=fixed)
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
        kind=rc.SPEED,
    )


def coordinates(estimate: Estimate) -> tuple[Array, int]:
    """Return an estimate in the coordinates of the fit, and its order."""
    z = np.zeros(len(models.Z_NAMES))
    z[models.A0] = -np.log(estimate.value("dc_gain"))
    lag, product = estimate.value("time_constant"), estimate.value("time_constant_product")
    z[models.A1] = z[models.A0] + (np.log(lag) if lag > 0 else -30.0)
    order = 2 if product > 0 else 1
    if order == 2:
        z[models.A2] = z[models.A0] + np.log(product)
        z[models.TE] = z[models.A2] - z[models.A1]
        inductance, resistance = estimate.value("inductance"), estimate.value("resistance")
        if inductance > 0 and resistance > 0:
            z[models.TE] = np.log(inductance / resistance)
    forward = estimate.value("static_voltage")
    z[models.VC_PLUS] = forward
    z[models.VC_MINUS] = estimate.value("static_voltage_reverse", forward)
    z[models.LOAD] = estimate.value("load_voltage")
    z[models.DELAY] = estimate.value("delay")
    z[models.WINDOW] = estimate.value("averaging_window")
    return z, order
