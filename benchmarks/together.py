# SPDX-License-Identifier: Apache-2.0
"""Compare the arrival of four different wheels under different loads.

Each motor of the paper is excited and recorded in a bag, identified, and tuned.  All wheels then
make the same step under different loads that the models do not contain, in two ways:

- plain: the tuned PID acts on the step itself;
- together: all wheels follow one minimum-jerk reference with the feed-forward of their own
  identified motor, the speed comes from the observer, and the integral takes up the load.

    python benchmarks/together.py [--output FOLDER] [--rates 100 200 1000] [--draws 5]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rclpy.serialization import serialize_message

from smp_interfaces.msg import MotorDescription, MotorState
from smp_motor_control.excitation import Fourier
from smp_motor_control.motor.file import MotorEntry, load_motors
from smp_motor_control.motor.parameters import MotorModel
from smp_motor_control.pid import PidGains
from smp_motor_control.wheel.loop import LoopSettings
from smp_motor_ident.bag import read_records
from smp_motor_ident.bag.writer import BagWriter
from smp_motor_ident.estimate import estimate
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune import Loop, design

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "test"))
from wheel_simulation import (  # noqa: E402
    DriveSettings,
    Run,
    Timing,
    simulate_closed_loop,
    simulate_open_loop,
)

ENTRIES = load_motors(ROOT / "config" / "motors_paper.yaml")
"""The paper's motors."""

SPEED = 100.0
"""Of every motor after the step [rad/s], as in the paper's figures."""

LOADS = {"front_left": 0.02, "front_right": 0.005, "rear_left": 0.30, "rear_right": 0.60}
"""Braking torque at the wheels [N m]: 0.36, 0.20, 0.50 and 0.70 V of the motors' armature."""

DELAY = 0.0005
"""From a sample to the voltage that answers it [s]."""

TRANSITION = 0.25
"""Of the common reference [s]: that of the slowest wheel's design, with some reserve."""

TORQUE_NOISE = 1e-3
"""Random load, as a share of each motor's torque per volt [V sqrt(s)].

It moves the free motor by 0.1 % of the step (rms), and increases the overshoot at 1 kHz beyond
0.5 %: three times the load gives 1.3 %."""


@dataclass(frozen=True)
class Arrival:
    """Settling and overshoot of the wheels.

    Attributes
    ----------
    settling : dict of str to float
        Time from the step until the true speed stays within 2 % [s]; NaN for never.
    overshoot : dict of str to float
        Largest excess of the true speed [%].
    """

    settling: dict[str, float]
    overshoot: dict[str, float]

    @property
    def spread(self) -> float:
        """Between the first and the last wheel [s]."""
        return max(self.settling.values()) - min(self.settling.values())


def record(
    entries: Mapping[str, MotorEntry], folder: Path, rate: float, duration: float, seed: int
) -> None:
    """Excite every motor, and record its hardware's reports into a bag."""
    excitation = Fourier(amplitude=10.0)
    start = 1_700_000_000_000_000_000
    with BagWriter(folder) as bag:
        for number, (wheel, entry) in enumerate(entries.items()):
            write_description(bag, wheel, entry, start)
            drive = DriveSettings(
                command_timeout=math.inf, current_noise=0.01, torque_noise=noise_of(entry)
            )
            run = simulate_open_loop(
                entry,
                excitation,
                duration,
                timing=Timing(sample_time=1.0 / rate, delay=DELAY),
                drive=drive,
                seed=seed * 10 + number,
            )
            write_states(bag, wheel, run, start)


def noise_of(entry: MotorEntry) -> float:
    p = entry.parameters
    return TORQUE_NOISE * p.motor_constant / p.resistance


def write_description(bag: BagWriter, wheel: str, entry: MotorEntry, stamp: int) -> None:
    description = MotorDescription(
        joint_name=f"{wheel}_wheel_joint",
        gear_ratio=entry.gearbox.ratio,
        counts_per_revolution=entry.encoder.counts_per_revolution,
        encoder_bits=entry.encoder.bits,
        supply_voltage=entry.supply_voltage,
        resistance=math.nan,
    )
    data = serialize_message(description)
    bag.write(f"/{wheel}/motor_description", "smp_interfaces/msg/MotorDescription", data, stamp)


def write_states(bag: BagWriter, wheel: str, run: Run, start: int) -> None:
    state = MotorState()
    state.header.frame_id = f"{wheel}_wheel_joint"
    for k, time in enumerate(run.time):
        stamp = start + round(time * 1e9)
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        state.voltage, state.current = float(run.voltage[k]), float(run.current[k])
        state.encoder_count = int(run.count[k])
        state.velocity, state.position = float(run.velocity[k]), float(run.position[k])
        data = serialize_message(state)
        bag.write(f"/{wheel}/motor_state", "smp_interfaces/msg/MotorState", data, stamp)


def identify(folder: Path) -> dict[str, Estimate]:
    """Estimate every motor of a bag from its voltage and counts."""
    records = read_records([folder])
    return {
        wheel: estimate(replace(record, current=None, velocity=None, position=None))
        for wheel, record in records.items()
    }


def model_of(found: Estimate) -> MotorModel:
    return MotorModel(
        dc_gain=found.value("dc_gain"),
        time_constant=found.value("time_constant"),
        time_constant_product=found.value("time_constant_product"),
        static_voltage=found.value("static_voltage"),
    )


def settings_of(found: Estimate, rate: float, together: bool) -> LoopSettings:
    """Tune a wheel from its estimate, for the one way or the other."""
    loop = Loop(
        sample_time=1.0 / rate,
        delay=DELAY,
        speed_source="observer" if together else "measured",
    )
    designed = design(found, loop, max_velocity=2.5)
    gains = designed.gains
    if together:
        return LoopSettings(
            gains=gains,
            transition_time=TRANSITION,
            reference_delay=designed.reference.lag,
            speed_source="observer",
            model=model_of(found),
        )
    plain = PidGains(
        p=gains.p,
        i=gains.i,
        d=gains.d,
        derivative_filter_time_constant=gains.derivative_filter_time_constant,
        u_clamp_min=gains.u_clamp_min,
        u_clamp_max=gains.u_clamp_max,
        antiwindup_strategy="conditional_integration",
    )
    return LoopSettings(gains=plain)


def drive(
    entries: Mapping[str, MotorEntry],
    settings: Mapping[str, LoopSettings],
    rate: float,
    seed: int,
    begin: float = 0.3,
    duration: float = 1.3,
) -> dict[str, Run]:
    """Step the set-point of all wheels, each with its own load."""
    runs = {}
    for number, (wheel, entry) in enumerate(entries.items()):
        setpoint = entry.gearbox.to_wheel(SPEED)
        runs[wheel] = simulate_closed_loop(
            entry,
            settings[wheel],
            lambda t, setpoint=setpoint: setpoint if t >= begin - 1e-9 else 0.0,
            duration,
            timing=Timing(sample_time=1.0 / rate, delay=DELAY),
            drive=DriveSettings(command_timeout=math.inf, torque_noise=noise_of(entry)),
            load=lambda t, load=LOADS[wheel]: load,
            seed=seed * 10 + number,
        )
    return runs


def assess(runs: Mapping[str, Run], begin: float = 0.3) -> Arrival:
    """Measure settling and overshoot of the true speeds.

    Between samples the speed is taken to be straight, so that times are finer than the
    control period.
    """
    settling, overshoot = {}, {}
    for wheel, run in runs.items():
        target = run.setpoint[-1]
        settling[wheel] = settling_time(run.time, run.velocity / target) - begin
        overshoot[wheel] = 100.0 * float(np.max(run.velocity) / target - 1.0)
    return Arrival(settling, overshoot)


def settling_time(time: np.ndarray, share: np.ndarray, band: float = 0.02) -> float:
    """Return when a signal enters the band around 1 for good; NaN if it ends outside."""
    away = np.abs(share - 1.0)
    outside = np.flatnonzero(away > band)
    if outside.size == 0:
        return float(time[0])
    last = int(outside[-1])
    if last + 1 >= time.size:
        return math.nan
    part = (away[last] - band) / (away[last] - away[last + 1])
    return float(time[last] + part * (time[last + 1] - time[last]))


def plot(
    runs: Mapping[str, Mapping[str, Run]], arrivals: Mapping[str, Arrival], file: Path
) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, sharey=True, figsize=(9.0, 3.6), layout="constrained")
    for axis, (way, wheels) in zip(axes, runs.items(), strict=True):
        arrival = arrivals[way]
        for wheel, run in wheels.items():
            speed = run.velocity / run.setpoint[-1] * SPEED
            axis.plot(run.time - 0.3, speed, label=wheel.replace("_", " "), linewidth=1.2)
        axis.axhspan(0.98 * SPEED, 1.02 * SPEED, color="0.9", zorder=0)
        axis.set_title(
            f"{way}: spread {1e3 * arrival.spread:.1f} ms, "
            f"overshoot {max(arrival.overshoot.values()):.1f} %"
        )
        axis.set_xlim(-0.05, 0.6)
        axis.set_xlabel("time [s]")
    axes[0].set_ylabel("motor speed [rad/s]")
    axes[1].legend(loc="lower right", frameon=False)
    figure.savefig(file)
    plt.close(figure)


def identify_recorded(
    entries: Mapping[str, MotorEntry], rate: float, seed: int, duration: float = 20.0
) -> dict[str, Estimate]:
    """Record a bag and identify the motors from it."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        record(entries, bag, rate, duration, seed)
        return identify(bag)


def compare(
    entries: Mapping[str, MotorEntry], found: Mapping[str, Estimate], rate: float, seed: int
) -> dict[str, dict[str, Run]]:
    """Tune and drive once, both ways."""
    return {
        way: drive(
            entries,
            {wheel: settings_of(found[wheel], rate, way == "together") for wheel in entries},
            rate,
            seed,
        )
        for way in ("plain", "together")
    }


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--output", type=Path, default=Path("together"))
    parser.add_argument("--rates", type=float, nargs="+", default=[100.0, 200.0, 1000.0])
    parser.add_argument("--draws", type=int, default=5)
    arguments = parser.parse_args(argv)
    arguments.output.mkdir(parents=True, exist_ok=True)
    entries = ENTRIES
    results = []
    print("rate [Hz]  way        settling [ms]                    spread [ms]  overshoot [%]")
    for rate in arguments.rates:
        for draw in range(arguments.draws):
            found = identify_recorded(entries, min(rate, 200.0), draw)
            runs = compare(entries, found, rate, draw)
            arrivals = {way: assess(wheels) for way, wheels in runs.items()}
            for way, arrival in arrivals.items():
                times = "  ".join(f"{1e3 * t:6.1f}" for t in arrival.settling.values())
                worst = max(arrival.overshoot.values())
                print(
                    f"{rate:9g}  {way:9}  {times:32} {1e3 * arrival.spread:11.1f}  {worst:13.2f}",
                    flush=True,
                )
                results.append({"rate": rate, "draw": draw, "way": way, **vars(arrival)})
            if draw == 0:
                plot(runs, arrivals, arguments.output / f"together_{rate:g}_hz.svg")
    (arguments.output / "together.json").write_text(json.dumps(results, indent=1))
    print(f"figures and numbers: {arguments.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
