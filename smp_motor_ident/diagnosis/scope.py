"""What stated values cover: structures that are alike, a single level, a motor that changes."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from smp_motor_ident.diagnosis.effects import EFFECTS
from smp_motor_ident.diagnosis.limits import (
    HALF_WIDTH,
    RELEVANT_BIAS,
    RESISTANCE_BAND,
    REST,
    SAME_LEVEL,
)
from smp_motor_ident.diagnosis.one_size import one_size, size_of_voltage
from smp_motor_ident.diagnosis.sample_limits import FRICTION_MOST
from smp_motor_ident.diagnosis.systematic import BY_CURRENT, of_current, of_one_size, of_timing
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.prediction import voltage_at_samples
from smp_motor_ident.estimation.quantities import Answer
from smp_motor_ident.estimation.segments import Change
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import LOGARITHMS, STANDS_FOR
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.record import Hardware, Record
from smp_motor_ident.result import Estimate


def scope(
    data: Experiments,
    result: Answer,
    change: Change,
    alike: Mapping[str, float],
    group: Sequence[Record],
    fit: Fit,
) -> Iterator[Finding]:
    """Yield what a reader must know of the values' meaning."""
    yield from one_size(data, fit, of_one_size(group[0].hardware))
    if not result.level:
        yield from _one_direction(data, result)
    if alike:
        yield _alike(alike)
    if result.level:
        yield _one_level(result, _turns_at_others(data, abs(result.level)))
    yield from _friction_dominates(result, float(np.abs(data.voltage).max()))
    yield from _current_scale(result, group[0].hardware, size_of_voltage(data) > 0)
    yield from _timing(result, group[0].hardware, data.step)
    if change.std:
        yield _motor_changes(change, group, float(np.abs(data.voltage).max()))


def _friction_dominates(result: Answer, top: float) -> Iterator[Finding]:
    """Say of a friction that takes most of the voltage what else it may be."""
    static = result.combinations.get("static_voltage")
    if static is None or static.value is None or static.value <= FRICTION_MOST.value * top:
        return
    yield Finding(
        "friction_dominates",
        "unreliable",
        f"{static.value:.3g} V of the {top:.3g} V at most hold the motor and do not move it: a "
        "driver that coasts between its pulses, a dead zone or a gear that jams look like that, "
        "and gain and time constant of what is left need not be the motor's",
        {"static_voltage": static.value, "largest": top},
        "drive with more voltage, let the driver brake between its pulses (slow decay), or record "
        "the voltage at the motor's terminals",
    )


def _motor_changes(change: Change, group: Sequence[Record], top: float) -> Finding:
    """Say that a motor changes, and name the record that alone differs from the others."""
    evidence: dict[str, float | str | None] = {
        STANDS_FOR.get(n, n): deviation for n, deviation in change.std.items()
    }
    advice = "let the motor warm up, or record on several days, to know how much it changes"
    units = {n: 1.0 if n in LOGARITHMS else top for n in change.differs}
    far = any(abs(d) > RELEVANT_BIAS.value * units[n] for n, d in change.differs.items())
    if change.segment is None or len(group) < 2 or not far:
        return Finding(
            "motor_changes",
            "note",
            "parts of the recordings differ by more than their noise (temperature, friction): "
            "the intervals are those of another recording of this motor",
            evidence,
            advice,
        )
    ends = np.cumsum([len(r.starts) for r in group])
    place = int(np.searchsorted(ends, change.segment, side="right"))
    name = group[place].source or f"record {place + 1}"
    return Finding(
        "motor_changes",
        "warning",
        f"{name} differs from the other recordings, which agree ({_differs(change.differs)}): "
        "another motor, wiring or scale, or a motor that changed in between; the values lie "
        "between, and the intervals are those of another recording",
        evidence | {"record": name},
        f"leave {name} out, unless the motor changes like that; then record more",
    )


def _differs(by: Mapping[str, float]) -> str:
    """Return in words by how much the coordinates of a record differ."""
    gain = by.get("ln_a0", 0.0)
    logarithms = {"ln_a0": -gain, "ln_a1": by.get("ln_a1", 0.0) - gain, "ln_r": by.get("ln_r", 0.0)}
    shares = {STANDS_FOR[n]: 100 * np.expm1(d) for n, d in logarithms.items() if n in by}
    words = [f"{name} {share:+.2g} %" for name, share in shares.items()]
    volts = [n for n in ("vc_plus", "vc_minus", "load") if n in by]
    return ", ".join([*words, *(f"{STANDS_FOR[n]} {by[n]:+.2g} V" for n in volts)])


def _alike(weights: Mapping[str, float]) -> Finding:
    words = ", ".join(f"{name} ({100 * w:.0f} %)" for name, w in weights.items())
    return Finding(
        "structures_alike",
        "note",
        f"the data do not decide between {words}: values and intervals cover them all",
        dict(weights),
        "sample faster, and excite with sharp steps of several sizes: a delay, an averaged "
        "speed and a second lag differ in the first samples after a step",
    )


def _one_direction(data: Experiments, result: Answer) -> Iterator[Finding]:
    """Say that friction and a constant load are one voltage where the motor turns one way only."""
    if not data.one_way:
        return
    if "load_voltage" in result.combinations:
        yield from _driving_load(data, result)
        return
    yield Finding(
        "one_direction",
        "warning",
        "the motor was driven one way only: static_voltage is friction and a constant load "
        "together, of which its interval leaves open how much is which",
        {"voltage": float(data.hold_value[np.argmax(np.abs(data.hold_value))])},
        "drive both directions",
    )


def _driving_load(data: Experiments, result: Answer) -> Iterator[Finding]:
    """Say it where, turning one way only, a motor seems to be driven by its load.

    Under ``v = K w + friction + load`` the gain is then more than speed over voltage: what says
    so is the shape of the answer alone, and hills that pull a robot are rare.
    """
    names = ("static_voltage", "load_voltage")
    sign = float(np.copysign(1.0, data.hold_value[np.argmax(np.abs(data.hold_value))]))
    value = sum(s * (result.combinations[n].value or 0.0) for n, s in zip(names, (1.0, sign)))
    row = np.array([{names[0]: 1.0, names[1]: sign}.get(n, 0.0) for n in result.names])
    std = float(np.sqrt(row @ result.covariance @ row))
    if value + HALF_WIDTH.value * std >= 0.0:
        return
    yield Finding(
        "driving_load",
        "unreliable",
        f"the motor would be driven by its load, by {-value:.3g} V more than friction takes, "
        "one way only: the steady speeds and the changes of speed ask for different gains",
        {"voltage": value, "std": std},
        "drive both directions, at several steady levels of voltage",
    )


def _current_scale(result: Answer, hardware: Hardware, one_size: bool) -> Iterator[Finding]:
    """Say what only the current's own scale determines, held against an ohmmeter if there is one.

    A resistance that is given determines it.  No record of voltage, current and motion shows that
    scale; under a voltage of one size the supply's current, ``i |v| / supply``, is another scale
    and no more.
    """
    known = {
        n: q for n in BY_CURRENT
        if (q := result.parameters.get(n)) is not None and q.status == "estimated"
    }  # fmt: skip
    if not known or result.parameters["resistance"].status == "fixed":
        return
    ohmmeter = hardware.resistance
    words = (
        f"the scale of the current's sensor, which no record shows, is in {', '.join(known)}, "
        f"whose intervals take it as known to {of_current(hardware):.2g}"
    )
    found = known.get("resistance")
    if found is None or found.value is None or not ohmmeter:
        advice = (
            "state the sensor's accuracy (`current_accuracy`), or the resistance by ohmmeter "
            "(`resistance`), which shows the scale"
        )
        evidence: dict[str, float | str | None] = {"of_the_scale": ", ".join(known)}
        if one_size:
            words += (
                "; under a voltage of one size the current of the supply looks like such a scale"
            )
        yield Finding("current_scale", "warning" if one_size else "note", words, evidence, advice)
        return
    scale = ohmmeter / found.value
    off = (
        abs(scale - 1) > RESISTANCE_BAND.value + HALF_WIDTH.value * (found.std or 0.0) / found.value
    )
    remedy = (
        "calibrate the current's sensor, or measure the resistance warm, at the current that drives"
    )
    yield Finding(
        "current_scale",
        "unreliable" if off else "note",
        f"{words}: by the ohmmeter's {ohmmeter:.4g} ohm it is {scale:.3g}",
        {"scale": scale, "ohmmeter": ohmmeter, "of_the_scale": ", ".join(known)},
        remedy if off else "",
    )


def _timing(result: Answer, hardware: Hardware, step: float) -> Iterator[Finding]:
    """Say that what is shorter than a sampling interval hangs on when the instruments read."""
    seconds = of_timing(hardware, step)
    known = {**result.parameters, **result.combinations}
    times = {n: q.value for n, q in known.items() if q.status == "estimated" and q.value}
    lag = times.get("time_constant_product", math.inf) / times.get("time_constant", 1.0)
    short = {"L/R": lag, "delay": times.get("delay", math.inf)}
    named = [n for n, long in short.items() if RELEVANT_BIAS.value * long < seconds]
    if named:
        yield Finding(
            "timing",
            "note",
            f"when the instruments read against the stamp of their row, which no record shows, is "
            f"in {', '.join(named)}, whose intervals take it as known to {1e3 * seconds:.2g} ms",
            {"seconds": seconds},
            "state how well that is known (`timing_accuracy`)",
        )


def _turns_at_others(data: Experiments, level: float) -> bool:
    """Tell whether a recorded speed is one under other voltages, too, at which a model stands."""
    if data.kind == ANGLE:
        return False
    speed, volts = np.abs(data.output), np.abs(voltage_at_samples(data))
    turns = speed > REST.value * np.nanmax(speed)
    other = (volts > REST.value * level) & (np.abs(volts - level) > SAME_LEVEL.value * level)
    return float(np.mean(turns & other)) > SAME_LEVEL.value


def _one_level(result: Answer, contradicted: bool) -> Finding:
    speed = result.combinations["steady_speed"]
    known = f"only the steady speed at {result.level:.3g} V is known, {speed.value:.4g} rad/s"
    evidence: dict[str, float | str | None] = {
        "voltage": result.level, "steady_speed": speed.value
    }  # fmt: skip
    if contradicted:
        return Finding(
            "one_level",
            "unreliable",
            f"of gain and static voltage {known}, though the motor turned at other voltages, too: "
            "no line goes through its speeds, and what bends it is not in the model",
            evidence,
            "record the voltage at the motor's terminals, or levels among which the motor will run",
        )
    return Finding(
        "one_level",
        "warning",
        f"of gain and static voltage {known}: every pair with this product "
        "dc_gain (voltage - static_voltage) moves the motor alike",
        evidence,
        "record two levels of voltage, or a reversal, to know gain and friction apart",
    )


OF_CURRENT = {effect.code: effect for effect in EFFECTS if effect.place == "current"}


def blames_current(finding: Finding) -> bool:
    """Tell whether a finding says that the current, not the motion, is off."""
    of_current = finding.code in OF_CURRENT or finding.code == "poor_fit_of_current"
    return finding.severity == "unreliable" and of_current


UNDECIDED = "undecided"
"""Why a current was left out that shows no fault of its own: with it nothing could be stated."""


def current_left_out(reason: str) -> Finding:
    """Return why the answer is one without the current, and what would make it useful.

    Where that shows no fault of its own, voltage or motion may be what is wrong: data that tell
    more do not tell less.
    """
    effect = OF_CURRENT.get(reason)
    what = f"shows {effect.cause}" if effect else "does not fit voltage and motion"
    if reason == "current_offset":
        what += ", of its sensor or of the driver, which puts out a voltage at no command,"
    return Finding(
        "current_left_out",
        "unreliable" if reason == UNDECIDED else "warning",
        f"the current {what}: this is the answer without it, and what only the current tells "
        "(resistance, inductance, motor constant, inertia, friction torques) is not stated",
        {"reason": reason},
        effect.advice if effect else "record the armature's current with its sign, unfiltered",
    )


def contradicted(
    with_it: Estimate | None, without: Estimate, blamed: Finding | None
) -> list[Finding]:
    """Say where motor and driver may be to blame as well as the current, and a number hangs on it.

    ``blamed`` is the finding by which the current was left out of an estimate that there was.
    """
    if with_it is None or blamed is None:
        return []
    others = str(blamed.evidence.get("alternatives") or "").split(", ")
    if not set(others) - set(OF_CURRENT) - {""}:
        return []
    name = differing(with_it, without)
    if name is None:
        return []
    a, b = with_it.combinations[name], without.combinations[name]
    return [
        Finding(
            "current_contradicts",
            "unreliable",
            f"{name} is {a.value:.4g} {a.unit} with the current and {b.value:.4g} without "
            "it, and motor or driver may be to blame as well as the current's sensor",
            {"quantity": name, "with": a.value, "without": b.value},
            "check the current's sensor; " + blamed.advice,
        )
    ]


def differing(one: Estimate, other: Estimate) -> str | None:
    """Return the name of a number in which two estimates of a motor contradict each other."""
    for name in ("dc_gain", "time_constant", "static_voltage"):
        a, b = one.combinations.get(name), other.combinations.get(name)
        if a is None or b is None or a.value is None or b.value is None:
            continue
        apart = abs(a.value - b.value)
        most = HALF_WIDTH.value * math.hypot(a.std or 0.0, b.std or 0.0)
        if apart > max(most, RELEVANT_BIAS.value * abs(b.value)):
            return name
    return None
