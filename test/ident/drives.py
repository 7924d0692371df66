# SPDX-License-Identifier: Apache-2.0
"""An identified drive, and the response of the true one by independent integration."""

import math

import numpy as np

from smp_motor_ident.record import Hardware
from smp_motor_ident.result import Estimate, FitPercent, Quantity
from smp_motor_ident.tune import Loop

MOTOR = {"dc_gain": 25.0, "time_constant": 0.05, "time_constant_product": 6e-4}
LOOP = Loop(sample_time=0.01, delay=0.01, gear_ratio=1.0, counts_per_revolution=2000.0)
TRUE = {**MOTOR, "static_voltage": 0.4}


def estimate(std: float = 0.01, findings=(), **more) -> Estimate:
    values = {**MOTOR, "static_voltage": 0.4, **more}
    deviations = [std * v for v in values.values()]
    return Estimate(
        "front_left",
        "second_order",
        {},
        {n: Quantity(v, s) for (n, v), s in zip(values.items(), deviations, strict=True)},
        tuple(values),
        np.diag(np.square(deviations)),
        FitPercent(97.0, 96.0),
        findings=tuple(findings),
        sample_time=0.01,
        hardware=Hardware(1.0, 2000.0, 0, 12.0),
    )


def change(one, motor, window=0.0, lag=0.0, share=0.5, seconds=2.0):
    """Return time and relative speed of a set-point change, integrated in small steps.

    The controller is written from the published rules of the running one; friction acts on the
    voltage's side.
    """
    T, sub = one.loop.sample_time, 50
    h = T / sub
    gains, plan, model = one.gains, one.reference, one.motor
    steps = int(seconds / T)
    target = share * plan.max_velocity
    profile = plan.profile()
    profile.set_target(target, T)
    path = [profile.ahead(k * T) for k in range(steps + 1)]
    r = np.array([p.velocity for p in path])
    a = np.array([p.acceleration for p in path])
    time = T * np.arange(steps)
    bend = model["time_constant_product"] / model["time_constant"]
    forward = gains.feedforward_velocity * (0.5 * (r[1:] + r[:-1]) - T / 12 * np.diff(a))
    forward += gains.feedforward_acceleration * (np.diff(r) + bend * np.diff(a)) / T
    forward += gains.feedforward_static
    late = [plan.lag + plan.doubt, plan.lag, max(plan.lag - plan.doubt, 0.0)]
    around = np.array([np.interp(time - x, time, r[:-1]) for x in late])
    gain, tau, tp, friction = (
        motor[n] for n in ("dc_gain", "time_constant", "time_constant_product", "static_voltage")
    )
    speed = rate = filtered = angle = integral = before = slope = 0.0
    angles, sent, out = [0.0], [0.0] * (round(one.loop.loop_delay / T) + 1), np.empty(steps)
    for k in range(steps):
        if lag:
            y = filtered
        else:
            back = max(round((window or T) / h), 1)
            y = (angles[-1] - (angles[-1 - back] if len(angles) > back else 0.0)) / (back * h)
        low, high = around[:, k].min(), around[:, k].max()
        e = min(max(y, low), high) - y
        tf = gains.derivative_filter_time_constant
        weighted = gains.setpoint_weight_d * (e + y) - y
        slope = (tf * slope + weighted - before) / (tf + T)
        before = weighted
        wanted = gains.p * (gains.setpoint_weight_p * (e + y) - y) + integral + gains.d * slope
        wanted += forward[k]
        given = min(max(wanted, -12.0), 12.0)
        integral += T * (gains.i * e + (given - wanted) / gains.tracking_time_constant)
        sent = [given, *sent[:-1]]
        out[k] = speed
        for _ in range(sub):
            pull = sent[-1] - motor.get("load_voltage", 0.0)
            drive = pull - math.copysign(friction, speed) if speed else max(pull - friction, 0.0)
            rate += h * (gain * drive - speed - tau * rate) / tp
            speed = max(speed + h * rate, 0.0)
            rate = rate if speed > 0 or drive > 0 else 0.0
            filtered += h * (speed - filtered) / lag if lag else 0.0
            angle += h * speed
            angles.append(angle)
    return time, out / target


def overshoot(one, motor, **sensor) -> float:
    return 100 * (change(one, motor, **sensor)[1].max() - 1)
