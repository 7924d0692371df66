# SPDX-License-Identifier: Apache-2.0
"""Reproduce the paper: writes docs/paper.md and its figures (``make paper``).

Everything in the page is computed here: the plant is Table 1, simulated by steps that share no
code with estimator and designer; identification and design are the project's own.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import paper_figures as figures
import scipy.signal
from closed_loop import (
    RATIO,
    SUPPLY,
    TABLE_1,
    TABLE_2,
    Conditions,
    Controller,
    as_delivered,
    from_gains,
    overshoot,
    run,
    settling,
)

from smp_motor_control.excitation import Fourier, Sine, Square
from smp_motor_control.motor.parameters import MotorParameters
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.tune import Loop, design_wheels
from smp_motor_ident.tune.feedback import Feedback, loop_margins, spectral_radius
from smp_motor_ident.tune.motors import Motors
from smp_motor_ident.tune.plant import sample

ROOT = Path(__file__).resolve().parent.parent
STEP = 100.0
"""Set-point of the comparisons [rad/s of the motor], 1.53 rad/s of the wheel."""

FILTER = 0.01
"""Derivative filter that the sampled Table 2 gets: the paper tells none, and without one the
derivative of a count is 50 kV/s."""

OUR_RATE = 200.0
SECONDS = 30.0
"""Length of each recording."""

NUMBER = {wheel: k + 1 for k, wheel in enumerate(TABLE_1)}
WAVES = {
    "sine": Sine(amplitude=SUPPLY, frequency=1.0),
    "square": Square(amplitude=SUPPLY, frequency=1.0),
    "Fourier": Fourier(amplitude=SUPPLY),
}


def combinations(motor):
    """Return a0, a1, a2 of a row of Table 1."""
    R, L, K, J, b = motor
    return (R * b + K * K) / K, (R * J + L * b) / K, L * J / K


def sampled(motor, loop):
    """Return the sampled plant of a row of Table 1."""
    a0, a1, a2 = combinations(motor)
    return sample(Motors(*(np.array([x]) for x in (a0, a1, a2, 0.0, 0.0))), loop)


# ---------------------------------------------------------------- identification


def record(wheel, wave, current):
    """Return one motor of Table 1 as recorded in a bag at 200 Hz."""
    R, L, K, J, b = TABLE_1[wheel]
    T = 0.005
    time = T * np.arange(int(SECONDS / T) + 1)
    voltage = np.concatenate([[0.0], wave(time[:-1])])
    A = np.array([[-R / L, -K / L, 0], [K / J, -b / J, 0], [0, 1, 0]])
    B = np.array([[1 / L], [0], [0]])
    system = scipy.signal.cont2discrete((A, B, np.eye(3), np.zeros((3, 1))), T)
    states = scipy.signal.dlsim((*system[:4], T), np.append(voltage[1:], 0.0))[2]
    noise = np.random.default_rng(NUMBER[wheel]).normal(0, 0.01, time.size)
    return Record(
        wheel=wheel,
        time=time,
        voltage=voltage,
        current=states[:, 0] + noise if current else None,
        count=np.floor(states[:, 2] * 500 / (2 * np.pi)).astype(np.int64),
        hardware=Hardware(RATIO, 500.0, 0, SUPPLY, R, 0.0, 0.0),
        source="simulated",
    )


def identify():
    """Return estimates by (wheel, wave, with current)."""
    found = {}
    for wheel in TABLE_1:
        for name, wave in WAVES.items():
            for current in (False, True) if name == "Fourier" else (False,):
                say(f"identifying motor {NUMBER[wheel]} from {name}{' with current' * current}")
                found[wheel, name, current] = estimate(record(wheel, wave, current))
    return found


def identification_table(found):
    """Return how far each combination is from the truth, in percent and in its own std."""
    lines = [
        "| motor | signal | dc gain | time constant | product | R, L, K, J, b one by one |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for (wheel, wave, current), e in found.items():
        if current:
            continue
        truth = MotorParameters(
            **dict(zip(_PHYSICAL, TABLE_1[wheel], strict=True)), coulomb_friction=0.0
        )
        cells = []
        for name in ("dc_gain", "time_constant", "time_constant_product"):
            q = e.combinations.get(name)
            if q is None or q.value is None:
                cells.append("not identifiable")
                continue
            true = getattr(truth, name)
            cells.append(f"{100 * (q.value / true - 1):+.3f} ± {100 * (q.std or 0) / true:.3f} %")
        refused = [n for n in e.unidentifiable if n != "coulomb_friction"]
        cells.append(f"refused: {len(refused)}" if refused else "identifiable")
        lines.append(f"| {NUMBER[wheel]} | {wave} | " + " | ".join(cells) + " |")
    return lines


_PHYSICAL = ("resistance", "inductance", "motor_constant", "inertia", "viscous_friction")
_LETTER = dict(zip(_PHYSICAL, "RLKJb", strict=True))


def parameter_table(found):
    """Return the five parameters with current measured, from the Fourier voltage."""
    lines = [
        "| motor | " + " | ".join(_LETTER.values()) + " |",
        "| --- " * 6 + "|",
    ]
    for wheel, row in TABLE_1.items():
        e = found[wheel, "Fourier", True]
        cells = []
        for name, true in zip(_PHYSICAL, row, strict=True):
            q = e.parameters[name]
            if q.value is None:
                cells.append("refused")
            else:
                cells.append(
                    f"{100 * (q.value / true - 1):+.3f} ± {100 * (q.std or 0) / true:.3f} %"
                )
        lines.append(f"| {NUMBER[wheel]} | " + " | ".join(cells) + " |")
    return lines


# ---------------------------------------------------------------- Table 2


@dataclass(frozen=True)
class Reading:
    """Interpretation of the gains of Table 2: of the speed of the motor or of the wheel."""

    name: str
    divisor: float

    def gains(self, wheel):
        return tuple(x / self.divisor for x in TABLE_2[wheel])


READINGS = (Reading("motor", 1.0), Reading("wheel", RATIO))
RATES = (100, 200, 1000, 5000)


def continuous(wheel, reading):
    """Return time, step response and voltage of the ideal continuous loop (Fig. 5)."""
    p, i, d = reading.gains(wheel)
    a0, a1, a2 = combinations(TABLE_1[wheel])
    system = scipy.signal.lti([d, p, i], [a2, a1 + d, a0 + p, i])
    return scipy.signal.step(system, T=np.linspace(0, 1.5, 30_001))


def continuous_table():
    """Return crossover, margins and step of Table 2 in continuous time."""
    lines = [
        "| reading | motor | crossover | phase margin | Kp times a step of 100 rad/s | "
        "settling (2 %) | overshoot |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for reading in READINGS:
        for wheel in TABLE_1:
            p, i, d = reading.gains(wheel)
            a0, a1, a2 = combinations(TABLE_1[wheel])
            w = np.geomspace(0.1, 1e5, 20_000)
            s = 1j * w
            loop = (p + i / s + d * s) / (a2 * s**2 + a1 * s + a0)
            k = np.flatnonzero(np.abs(loop) > 1)[-1]
            time, y = continuous(wheel, reading)
            lines.append(
                f"| {reading.name} | {NUMBER[wheel]} | {w[k]:.0f} rad/s | "
                f"{180 + np.rad2deg(np.angle(loop[k])):.0f}° | {p * STEP:.1f} V | "
                f"{1e3 * settling(time, y, 1.0):.0f} ms | {overshoot(y, 1.0):.1f} % |"
            )
    return lines


def sampled_table():
    """Return spectral radius, settling and overshoot of Table 2 in sampled loops."""
    lines = [
        "| reading | rate | spectral radius, motors 1 to 4 | settling (2 %) at 12 V | overshoot |",
        "| --- | --- | --- | --- | --- |",
    ]
    for reading in READINGS:
        for rate in RATES:
            radii, times, overs = [], [], []
            for wheel, motor in TABLE_1.items():
                p, i, d = reading.gains(wheel)
                plant = sampled(motor, Loop(sample_time=1 / rate))
                radii.append(spectral_radius(plant, Feedback(p, i, d, FILTER))[0])
                time, speed = table_2_step(wheel, reading, rate)
                times.append(settling(time, speed, STEP))
                overs.append(overshoot(speed, STEP))
            lines.append(
                f"| {reading.name} | {rate} Hz | {', '.join(f'{r:.3f}' for r in radii)} | "
                f"{', '.join(milliseconds(t) for t in times)} | "
                f"{', '.join(f'{o:.0f}' for o in overs)} % |"
            )
    return lines


def milliseconds(seconds):
    """Return a time for a table."""
    return "does not" if np.isnan(seconds) else f"{1e3 * seconds:.0f} ms"


def table_2_step(wheel, reading, rate, seconds=1.0):
    """Return time and speed of a step with Table 2: counts, 12 V, one sample of delay."""
    T = 1 / rate
    time = T * np.arange(int(seconds * rate) + 1)
    controller = Controller(*reading.gains(wheel), filter_time=FILTER, weight_d=0.0)
    speed = run(TABLE_1[wheel], controller, Conditions(T, T), np.full(time.size, STEP))[0]
    return time, speed


# ---------------------------------------------------------------- four wheels


def ours(found, rate, together):
    """Return designs for the identified motors, apart or together."""
    estimates = {wheel: found[wheel, "Fourier", False] for wheel in TABLE_1}
    loops = {
        w: Loop(sample_time=1 / rate, delay=1 / rate, supply_voltage=SUPPLY) for w in estimates
    }
    if together:
        return dict(design_wheels(estimates, loops).designs)
    return {w: design_wheels({w: e}, {w: loops[w]}).designs[w] for w, e in estimates.items()}


def our_step(wheel, design):
    """Return time, speed and voltage of a step as the wheel node makes it."""
    T = design.loop.sample_time
    time = T * np.arange(int(1.0 / T) + 1)
    reference, forward, high = as_delivered(design, STEP, time)
    speed, voltage, _ = run(
        TABLE_1[wheel], from_gains(design.gains), Conditions(T, T), reference, forward, high=high
    )
    return time, speed, voltage


def wheels_table(runs):
    """Return settling of four wheels for each way of control, and their spread."""
    lines = [
        "| controller | settling of wheels 1 to 4 | spread | overshoot |",
        "| --- | --- | --- | --- |",
    ]
    for name, wheels in runs.items():
        times = [settling(t, y, STEP) for t, y in wheels.values()]
        spread = milliseconds(max(times) - min(times)) if np.all(np.isfinite(times)) else "—"
        over = ", ".join(f"{overshoot(y, STEP):.1f}" for _, y in wheels.values())
        lines.append(
            f"| {name} | {', '.join(milliseconds(t) for t in times)} | {spread} | {over} % |"
        )
    return lines


def say(text):
    """Show progress."""
    print(f"paper: {text}", file=sys.stderr, flush=True)


def main():
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=ROOT / "docs", help="folder of the page")
    output = parser.parse_args().output
    folder = output / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    found = identify()
    say("Table 2 in continuous and sampled time")
    motor, wheel = READINGS
    apart, together = ours(found, OUR_RATE, False), ours(found, OUR_RATE, True)
    runs = {
        "Table 2, wheel reading, 1 kHz": {w: table_2_step(w, wheel, 1000) for w in TABLE_1},
        "Table 2, wheel reading, 100 Hz": {w: table_2_step(w, wheel, 100) for w in TABLE_1},
        "ours, 200 Hz, each as fast as it can": {w: our_step(w, d)[:2] for w, d in apart.items()},
        "ours, 200 Hz, together": {w: our_step(w, d)[:2] for w, d in together.items()},
    }
    more = {
        f"ours, {rate:g} Hz, together": {
            w: our_step(w, d)[:2] for w, d in ours(found, rate, True).items()
        }
        for rate in (100.0, 1000.0)
    }
    say("figures")
    figures.fig_5(
        folder / "paper_fig5.svg",
        {r.name: continuous("front_left", r) for r in READINGS},
        {f"{r.name}, {rate} Hz": table_2_step("front_left", r, rate, 0.5)
         for r in READINGS for rate in RATES},
        STEP,
    )  # fmt: skip
    figures.fig_6(folder / "paper_fig6.svg", runs, STEP, RATIO)
    page = TEXT.format(
        combinations="\n".join(combination_table()),
        identification="\n".join(identification_table(found)),
        parameters="\n".join(parameter_table(found)),
        continuous="\n".join(continuous_table()),
        sampled="\n".join(sampled_table()),
        gains="\n".join(gains_table(together)),
        wheels="\n".join(wheels_table({**runs, **more})),
        step=f"{STEP:g}",
        wheel_step=f"{STEP / RATIO:.2f}",
        rate=f"{OUR_RATE:g}",
        seconds=f"{SECONDS:g}",
    )
    (output / "paper.md").write_text(page, encoding="utf-8")
    say(f"written: {output / 'paper.md'}")
    return 0


def combination_table():
    """Return what fixes each motor's response, from Table 1."""
    lines = [
        "| motor | R | L | K | J | b | dc gain | time constant | product | top speed at 12 V |",
        "| --- " * 10 + "|",
    ]
    for wheel, (R, L, K, J, b) in TABLE_1.items():
        a0, a1, a2 = combinations((R, L, K, J, b))
        lines.append(
            f"| {NUMBER[wheel]} | {R:g} ohm | {L:g} H | {K:g} V s/rad | {J:g} kg m² | "
            f"{b:g} N m s | "
            f"{1 / a0:.2f} rad/s/V | {1e3 * a1 / a0:.1f} ms | {1e6 * a2 / a0:.0f} ms² | "
            f"{SUPPLY / a0:.0f} rad/s, {SUPPLY / a0 / RATIO:.1f} at the wheel |"
        )
    return lines


def gains_table(designs):
    """Return our gains and those of Table 2, both per rad/s of the wheel."""
    lines = [
        "| motor | Table 2: Kp, Ki, Kd | ours: Kp, Ki, Kd | phase margin | Ms "
        "| Table 2 at 200 Hz |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for wheel, d in designs.items():
        p, i, dd = (x / RATIO for x in TABLE_2[wheel])
        plant = sampled(TABLE_1[wheel], Loop(sample_time=1 / OUR_RATE))
        m = loop_margins(plant, Feedback(p, i, dd, FILTER))
        theirs = f"{m.phase:.0f}°, Ms {m.sensitivity:.1f}" if m.stable else "unstable"
        g = d.gains
        lines.append(
            f"| {NUMBER[wheel]} | {', '.join(f'{x:.4g}' for x in TABLE_2[wheel])} | "
            f"{g.p:.3f}, {g.i:.1f}, {g.d:.4f} | {d.margins.phase:.0f}° | "
            f"{d.margins.sensitivity:.2f} | {theirs} |"
        )
    return lines


TEXT = (Path(__file__).with_name("paper.template.md")).read_text(encoding="utf-8")

if __name__ == "__main__":
    sys.exit(main())
