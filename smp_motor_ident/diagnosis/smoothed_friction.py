"""What friction that a load's fluctuations smooth moves: a motor that they keep from resting.

The model's friction opposes the speed that its observer predicts, and holds a motor that is
predicted to rest.  The motor's own speed is normal around the predicted one, and its friction, on
average,

    Vc E[sign w] = Vc sign(m) (1 - erfc(|m| / (s sqrt 2))):

where it turns by less than the scatter s, as one that a controller holds near a speed of nothing,
it creeps at voltages that are less than Vc, of which a fit makes less friction and a lower gain.
Torque noise that makes the speed wander by ``a`` [rad/s per root of s] leaves a motor that runs
``s^2 = a^2 tau / 2``, one that is observed less.  With the friction's share that is missing given
back the motor is fitted again, and once more with the friction of that: the numbers are known no
better than they move.

References
----------
A. Gelb, W. Vander Velde, Multiple-Input Describing Functions (1968), chapter 7 (random inputs).
"""

import math
from dataclasses import replace

import numpy as np
from scipy.special import erfc

from smp_motor_control.arrays import Array
from smp_motor_ident.estimation.descent import refine
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.prediction import simulate
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.measurement import ANGLE

PASSES = 2  # the first finds how much friction there is, the second what it does


def acceleration_noise(fit: Fit) -> float:
    """Return how fast the torque noise makes the speed wander [rad/s per square root of s].

    Of the innovations' variance the counter's own share is what its gain on the angle leaves.
    """
    own = float(fit.noise[0, 0] * (1.0 - fit.gain[2, 0]))
    return math.sqrt(max(fit.noise_ratio * own, 0.0))


def smoothed(data: Experiments, fit: Fit, options: Options) -> tuple[Fit, list[Finding]]:
    """Return the fit with its covariance widened by what smoothed friction moves, and say so."""
    scatter = acceleration_noise(fit) * math.sqrt(0.5 * fit.z.time_constant)
    if data.kind != ANGLE or not scatter > 0.0 or "vc_plus" not in fit.structure.free:
        return fit, []
    now = fit
    for _ in range(PASSES):
        voltage = data.hold_value + _missing(data, now, scatter)
        now = refine(replace(data, hold_value=voltage), fit.structure, now, now.z, options)
        if not math.isfinite(now.deviance):
            return fit, []
    move = fit.structure.of_free(now.z.array - fit.z.array)
    place = fit.structure.free.index("vc_plus")
    wide = fit.along(move)
    if abs(move[place]) < math.sqrt(float(fit.covariance()[place, place])):
        return wide, []
    return wide, [
        Finding(
            "smoothed_friction",
            "note",
            f"where the motor turns by less than {scatter:.2g} rad/s, a load that fluctuates "
            "keeps friction from holding it, and friction may be "
            f"{now.z.vc_plus:.3g} V: the intervals cover that",
            {"scatter": scatter, "static_voltage": now.z.vc_plus},
            "record at higher speeds, or without what makes the load fluctuate",
        )
    ]


def _missing(data: Experiments, fit: Fit, scatter: float) -> Array:
    """Return the friction that a scatter of the speed takes away, in volts, of each section."""
    run = simulate(data, fit, gain=True)[:, 0]
    begins = [*map(int, data.hold_start[: len(data.starts) - 1]), data.hold_end.size]
    speed = np.empty(data.hold_end.size)
    for g, (a, b) in enumerate(zip(data.starts[:-1], data.starts[1:], strict=True)):
        part = slice(begins[g], begins[g + 1])
        end = data.hold_end[part]
        middle = end - 0.5 * np.diff(end, prepend=min(float(data.time[a]), float(end[0])))
        speed[part] = np.interp(middle, data.time[a:b], run[a:b])
    friction = np.where(speed > 0, fit.z.vc_plus, -fit.z.vc_minus) * (speed != 0.0)
    return np.asarray(friction * erfc(np.abs(speed) / (scatter * math.sqrt(2.0))))
