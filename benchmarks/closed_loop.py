# SPDX-License-Identifier: Apache-2.0
"""Simulate the loop of one wheel by small fixed steps; shares no code with the designer.

Motor by its physical equations (Runge-Kutta), encoder as floored counts, PID written from the
published contract of the running controller, voltage clamp, anti-windup, transport delay.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np

TABLE_1 = {
    "front_left": (12.919, 0.30994, 0.011029, 1.13e-6, 2.40e-5),
    "front_right": (4.5516, 0.06754, 0.001761, 6.60e-7, 2.23e-5),
    "rear_left": (3.2843, 0.06383, 0.030117, 1.40e-5, 5.53e-5),
    "rear_right": (2.7031, 0.03995, 0.035314, 2.21e-5, 6.45e-5),
}
"""The paper's Table 1: R [ohm], L [H], K [V s/rad], J [kg m^2], b [N m s/rad]."""

TABLE_2 = {
    "front_left": (5.6118, 137.8855, 0.055295),
    "front_right": (7.7383, 252.5987, 0.053161),
    "rear_left": (5.5694, 137.7014, 0.053119),
    "rear_right": (5.665, 158.2641, 0.049155),
}
"""The paper's Table 2: Kp, Ki, Kd, in units that the paper does not give."""

RATIO, COUNTS, SUPPLY = 65.5, 500.0, 12.0


@dataclass(frozen=True)
class Controller:
    """Settings of the PID, in volts per rad/s of the motor."""

    p: float
    i: float
    d: float = 0.0
    filter_time: float = 0.0
    weight: float = 1.0
    weight_d: float = 0.0
    tracking: float = np.inf

    def array(self) -> np.ndarray:
        return np.array([getattr(self, name) for name in self.__dataclass_fields__])


@dataclass(frozen=True)
class Conditions:
    """Operating conditions of the loop."""

    sample_time: float
    delay: float
    counts: float = COUNTS  # 0: an ideal tachometer
    window: int = 1  # samples that the speed is averaged over; 0: instantaneous
    supply: float = SUPPLY
    coulomb: float = 0.0  # [N m]
    gain: float = 1.0  # factor on the voltage that reaches the motor
    start: float = field(default=0.0)  # speed at the beginning [rad/s]


@numba.njit(cache=True)
def _advance(i, w, v, R, L, K, J, b, tc, load, h, steps):
    swept = 0.0
    for _ in range(steps):
        drag = tc if w > 0.0 else (-tc if w < 0.0 else 0.0)
        if w == 0.0:
            push = K * i - load
            drag = min(max(push, -tc), tc)
        a1, b1 = (v - R * i - K * w) / L, (K * i - b * w - drag - load) / J
        i2, w2 = i + 0.5 * h * a1, w + 0.5 * h * b1
        a2, b2 = (v - R * i2 - K * w2) / L, (K * i2 - b * w2 - drag - load) / J
        i3, w3 = i + 0.5 * h * a2, w + 0.5 * h * b2
        a3, b3 = (v - R * i3 - K * w3) / L, (K * i3 - b * w3 - drag - load) / J
        i4, w4 = i + h * a3, w + h * b3
        a4, b4 = (v - R * i4 - K * w4) / L, (K * i4 - b * w4 - drag - load) / J
        i += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        new = w + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
        if tc > 0.0 and new * w < 0.0:
            new = 0.0
        swept += 0.5 * h * (w + new)
        w = new
    return i, w, swept


@numba.njit(cache=True)
def _run(
    motor, controller, T, delay, counts, window, supply, tc, gain, start, low, high, forward, load
):
    R, L, K, J, b = motor
    p, ki, d, tf, weight, weight_d, tracking = controller
    n = low.size
    speed, volts, measured_speed = np.empty(n), np.empty(n), np.empty(n)
    whole = int(delay / T + 1e-9)
    late = max(delay - whole * T, 0.0)
    sent = np.zeros(whole + 2)
    i, w, angle = (b * start + tc) / K, start, 0.0
    integral = (R * (b * start + tc) / K + K * start) if start != 0.0 else 0.0
    sent[:] = integral
    angles = np.zeros(window + 1)
    for q in range(window + 1):
        angles[q] = -q * T * start
    # An eighth of the fastest time constant, and never fewer than 4 steps a sample.
    fast = min(L / R, J * R / (K * K + b * R) + 1e-12, T)
    h_wanted = min(fast / 8, T / 4)
    previous, rate_d, begun = 0.0, 0.0, False
    for k in range(n):
        if window > 0:
            new, old = angles[0], angles[window]
            if counts > 0:
                q = 2 * np.pi / counts
                new, old = np.floor(new / q) * q, np.floor(old / q) * q
            y = (new - old) / (window * T)
        else:
            y = w
        r = min(max(y, low[k]), high[k])
        slope = weight_d * r - y
        if not begun:
            previous, begun = (weight_d - 1) * y, True
        rate_d = (tf * rate_d + slope - previous) / (tf + T)
        previous = slope
        wanted = p * (weight * r - y) + integral + d * rate_d + forward[k]
        if k == 0 and start != 0.0:
            # Settled at the start: the integral holds whatever the other terms do not.
            integral -= wanted - sent[0]
            wanted = sent[0]
        given = min(max(wanted, -supply), supply)
        integral += T * (ki * (r - y) + (given - wanted) / tracking)
        speed[k], volts[k], measured_speed[k] = w, given, y
        for q in range(whole + 1, 0, -1):
            sent[q] = sent[q - 1]
        sent[0] = given
        swept_all = 0.0
        if late > 0.0:
            m = int(np.ceil(late / h_wanted))
            i, w, swept = _advance(
                i, w, gain * sent[whole + 1], R, L, K, J, b, tc, load[k], late / m, m
            )
            swept_all += swept
        m = int(np.ceil((T - late) / h_wanted))
        i, w, swept = _advance(
            i, w, gain * sent[whole], R, L, K, J, b, tc, load[k], (T - late) / m, m
        )
        angle += swept_all + swept
        for q in range(window, 0, -1):
            angles[q] = angles[q - 1]
        angles[0] = angle
    return speed, volts, measured_speed


def run(motor, controller, conditions, reference, forward=None, load=None, high=None):
    """Return true speed [rad/s], voltage [V] and measured speed at the sampling instants.

    ``motor`` is R, L, K, J, b; ``load`` a torque [N m] at each sample.  With ``high`` there is no
    error while the measurement is between ``reference`` and that.
    """
    c = conditions
    zero = np.zeros(reference.size)
    return _run(
        np.array(motor, dtype=float), controller.array(), c.sample_time, c.delay, c.counts,
        c.window, c.supply, c.coulomb, c.gain, c.start, np.asarray(reference, dtype=float),
        np.asarray(reference if high is None else high, dtype=float),
        zero if forward is None else forward, zero if load is None else load,
    )  # fmt: skip


def minimum_jerk(distance, duration, time):
    """Return the minimum-jerk change of speed, its rate and its jerk."""
    s = np.clip(time / duration, 0.0, 1.0)
    return (
        distance * (10 * s**3 - 15 * s**4 + 6 * s**5),
        distance / duration * (30 * s**2 - 60 * s**3 + 30 * s**4),
        distance / duration**2 * (60 * s - 180 * s**2 + 120 * s**3),
    )


def as_delivered(design, distance, time, ratio=RATIO):
    """Return reference, feed-forward and upper reference of a change as the wheel node makes them.

    The path is that of the running node; gains are per wheel rad/s.
    """
    gains, plan, model = design.gains, design.reference, design.motor
    T = time[1] - time[0]
    profile = plan.profile()
    profile.set_target(distance, T)
    path = [profile.ahead(k * T) for k in range(time.size + 1)]
    speed, rate = np.array([(r.velocity, r.acceleration) for r in path]).T
    bend = model["time_constant_product"] / model["time_constant"]
    mean = (speed[1:] + speed[:-1]) / 2 - T / 12 * np.diff(rate)
    forward = gains.feedforward_velocity * mean
    forward += gains.feedforward_acceleration * (np.diff(speed) + bend * np.diff(rate)) / T
    forward = forward / ratio + gains.feedforward_static * np.sign(mean)
    late = (plan.lag + plan.doubt, plan.lag, max(plan.lag - plan.doubt, 0.0))
    seen = [np.interp(time - each, time, speed[:-1]) for each in late]
    return np.min(seen, axis=0), forward, np.max(seen, axis=0)


def settling(time, speed, final, band=0.02):
    """Return when the speed enters the band for good [s], NaN if it does not."""
    outside = np.flatnonzero(np.abs(speed - final) > band * abs(final))
    last = outside[-1] if outside.size else -1
    return time[last + 1] if last + 1 < time.size else np.nan


def overshoot(speed, final):
    """Return the overshoot [%]."""
    return max(100 * (speed.max() / final - 1), 0.0)


def from_gains(gains, ratio=RATIO):
    """Return the controller of a design's ``PidGains``, which are per wheel rad/s."""
    tracking = gains.tracking_time_constant
    return Controller(
        gains.p / ratio,
        gains.i / ratio,
        gains.d / ratio,
        gains.derivative_filter_time_constant,
        gains.setpoint_weight_p,
        gains.setpoint_weight_d,
        tracking if gains.antiwindup_strategy == "back_calculation" else np.inf,
    )
