# SPDX-License-Identifier: Apache-2.0
"""Compare the noise of the loop with the observer and with differenced counts.

The same gains, so the same bandwidth, once fed with counts differenced over one sample and
once with the observer, on every motor of the paper with an encoder of 500 counts. The
observer's model is wrong by 1 % (drawn at random) in each number, and the motor carries a load
that the model does not know. Measured while the reference moves slowly, so that the counts
cannot lock to the sampling:

- speed error: root mean square of the fed speed less the true one [rad/s, motor];
- voltage noise: root mean square of the command less the one that the true speed would have
  given the same controller [V].

    python benchmarks/observer.py [--rates 200 1000] [--duration 4]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smp_motor_control.encoder import DifferencedSpeed
from smp_motor_control.motor.file import MotorEntry, load_motors
from smp_motor_control.motor.friction import Motor
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.observer import SpeedObserver
from smp_motor_control.pid import Pid, PidGains

ROOT = Path(__file__).resolve().parent.parent
BANDWIDTH = {200.0: 25.0, 1000.0: 40.0}
"""Of the loop by its rate [rad/s]: near what differenced counts still bear."""

WRONG = 0.01
LOAD = 0.5
"""Of the motor, as a voltage [V]."""


@dataclass(frozen=True)
class Noise:
    """Effect of a speed source on the loop."""

    speed: float
    voltage: float


def wrong_model(entry: MotorEntry, seed: int) -> MotorModel:
    rng = np.random.default_rng(seed)
    p = entry.parameters
    names = ("dc_gain", "time_constant", "time_constant_product", "static_voltage")
    factors = 1.0 + WRONG * rng.standard_normal(len(names))
    return MotorModel(**{n: getattr(p, n) * float(f) for n, f in zip(names, factors, strict=True)})


def gains_for(model: MotorModel, bandwidth: float) -> PidGains:
    """PI gains that put the crossover of the motor's slow pole at the bandwidth, at the motor."""
    return PidGains(
        p=model.time_constant / model.dc_gain * bandwidth,
        i=bandwidth / model.dc_gain,
        u_clamp_min=-12.0,
        u_clamp_max=12.0,
        antiwindup_strategy="conditional_integration",
        feedforward_velocity=1 / model.dc_gain,
        feedforward_static=model.static_voltage,
    )


def run(entry: MotorEntry, rate: float, observed: bool, duration: float, seed: int) -> Noise:
    """Close the loop on one motor and measure the effect of its speed source."""
    dt = 1.0 / rate
    model = wrong_model(entry, seed)
    p = entry.parameters
    motor, encoder = Motor(p), entry.encoder
    gains = gains_for(model, BANDWIDTH[rate])
    pid, quiet = Pid(gains), Pid(gains)
    observer = SpeedObserver(model, dt, encoder)
    differenced = DifferencedSpeed(encoder)
    torque = LOAD * p.motor_constant / p.resistance
    voltage, errors, noise = 0.0, [], []
    for k in range(round(duration * rate)):
        time = k * dt
        count = encoder.count(motor.angle)
        fed = observer.step(count, voltage, dt) if observed else differenced.step(time, count)
        if math.isnan(fed):
            fed = 0.0
        reference = 80.0 + 20.0 * math.sin(2.0 * math.pi * 0.31 * time)
        voltage = pid.step(reference, fed, dt).output
        # The same controller, with the same integral, on the true speed.
        quiet.i_term = pid.i_term
        ideal = quiet.step(reference, motor.speed, dt).output
        if time > 1.0:
            errors.append(fed - motor.speed)
            noise.append(voltage - ideal)
        motor.step(voltage, dt, torque)
    return Noise(rms(errors), rms(noise))


def rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rates", type=float, nargs="+", default=[200.0, 1000.0])
    parser.add_argument("--duration", type=float, default=4.0)
    arguments = parser.parse_args(argv)
    print("rate [Hz]  motor        speed error [rad/s]         voltage noise [V]")
    print("                        counts  observer  ratio     counts  observer  ratio")
    worst = 0.0
    for rate in arguments.rates:
        for seed, (wheel, entry) in enumerate(
            load_motors(ROOT / "config/motors_paper.yaml").items()
        ):
            counts, seen = (
                run(entry, rate, way, arguments.duration, seed) for way in (False, True)
            )
            speed, voltage = seen.speed / counts.speed, seen.voltage / counts.voltage
            worst = max(worst, speed, voltage)
            print(
                f"{rate:9g}  {wheel:11}  {counts.speed:6.3f}  {seen.speed:8.3f}  {speed:5.2f}    "
                f"{counts.voltage:7.4f}  {seen.voltage:8.4f}  {voltage:5.2f}"
            )
    print(f"largest ratio {worst:.2f} (asked for: at most 0.50)")
    return 0 if worst <= 0.5 else 1


if __name__ == "__main__":
    raise SystemExit(main())
