"""The model's error and its responses to effects, the model's own coordinates projected out.

The columns of effects are carried through a pass over the data beside the motor, as its
sensitivities are: they stick, are delayed and are corrected by the measurements as the model is.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import helmert

from smp_motor_control.arrays import Array, Integers
from smp_motor_ident.diagnosis.effect_regression import Regression
from smp_motor_ident.diagnosis.effects import EFFECTS, Effect, Motion, slope
from smp_motor_ident.diagnosis.limits import EFFECT_OWN
from smp_motor_ident.diagnosis.sample_limits import ORDINARY_BEND
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.passes import answers, own_columns, row_starts
from smp_motor_ident.likelihood.sensitivities import LANES
from smp_motor_ident.model.measurement import ANGLE

BLOCKS = 40  # whose sums of scores give the covariance
ROWS = 6_000  # of each output that the regression has at most
ROOM = 16_000_000  # numbers in a table of signals
SEGMENTS = 20  # beyond which only the angle's offset of each is projected out


def regression(
    data: Experiments, fit: Fit, gear: float, changing: bool = False
) -> Regression | None:
    """Return residuals and responses, whitened, the model's coordinates projected out.

    Of a motor that changes from segment to segment those of each: that is in the intervals, and no
    effect.
    """
    if not fit.structure.free or data.size < 4 * BLOCKS:
        return None
    sections, samples = motions(data, fit, gear)
    members: list[tuple[Effect, tuple[int, ...]]] = []
    peaks: list[float] = []  # [V]

    def made() -> Iterator[Signal]:
        count = 0
        for effect in EFFECTS:
            several = signals(effect, sections, samples)
            if several:
                members.append((effect, tuple(range(count, count + len(several)))))
            count += len(several)
            peaks.extend(0.0 if s.voltage is None or not effect.bends else _largest(s.voltage)
                         for s in several)  # fmt: skip
            yield from several

    sums = own_responses(data, fit, together(data))
    apart = _apart(data, sums, len(fit.structure.free) if changing else 0)
    own = whitened(data, fit, np.concatenate([sums, apart], axis=2))
    error = stacked(data, fit, measured(data) - predicted(data, fit))
    columns = [error, *own, *whitened(data, fit, responses(data, fit, made()))]
    table = np.array(columns).T  # columns stay together in memory
    if np.count_nonzero(columns[0]) < 4 * BLOCKS or not np.isfinite(table).all():
        return None
    block = row_starts(data, together(data)) * BLOCKS // data.size
    block = np.tile(block, 2 if data.current.size else 1)
    whole = _projected(table, len(own), block, members, len(fit.structure.free))
    seen = {c for _, columns in whole.members for c in columns}
    hidden = [
        (effect, c, ORDINARY_BEND.value * samples.top / peaks[c])
        for effect, columns in members
        for c in columns
        if effect.bends and c not in seen and peaks[c] > 0
    ]
    conditions = _conditions(data, samples)
    return replace(whole, conditions=conditions, hidden=hidden, changing=changing)


def _apart(data: Experiments, sums: Array, count: int) -> Array:
    """Return what the segments' own coordinates move around their means, shape (rows, o, c)."""
    segments = len(data.starts) - 1
    if not count or not 1 < segments <= SEGMENTS:
        return sums[:, :, :0]
    of = np.searchsorted(data.starts, row_starts(data, together(data)), side="right") - 1
    own = sums[:, :, :count, None] * helmert(segments).T[of][:, None, None, :]
    return np.asarray(own.reshape(*sums.shape[:2], -1))


def _largest(values: Array) -> float:
    return float(np.abs(values).max(initial=0.0))


def _conditions(data: Experiments, m: Motion) -> dict[str, Array]:
    """Return the halves of the motion by each condition that there is, for every row."""
    begins = row_starts(data, together(data))
    voltage, speed, drop = m.voltage[begins], m.speed[begins], m.drop[begins]
    out = {
        "size of the voltage": _halves(np.abs(voltage)),
        "speed": _halves(np.abs(speed)),
        "acceleration": _halves(np.abs(np.gradient(m.speed)[begins])),
        "direction": np.sign(speed),
        "braking": np.sign(voltage * drop),
    }
    if data.current.size:
        out = {name: np.tile(half, 2) for name, half in out.items()}
        out["current"] = np.repeat([-1.0, 1.0], begins.size)
    return {name: half for name, half in out.items() if np.ptp(half) > 0}


def _halves(size: Array) -> Array:
    """Return 1 where a size is above median and mean, half each, else -1; alike where it is one."""
    middle = 0.5 * float(np.median(size)) + 0.5 * float(np.mean(size))
    return np.where(size > middle + 0.02 * float(size.max()), 1.0, -1.0)


def _projected(
    table: Array,
    n_own: int,
    block: Integers,
    members: Sequence[tuple[Effect, tuple[int, ...]]],
    n_free: int,
) -> Regression:
    whole = own = table[:, 1 : 1 + n_own]
    rest = np.asfortranarray(table[:, [0, *range(1 + n_own, table.shape[1])]])
    scale = np.sqrt(np.square(own).sum(axis=0))
    own = own / np.where(scale > 0, scale, 1.0)
    answer = np.linalg.lstsq(own.T @ own, own.T @ rest, rcond=1e-12)[0]
    left = rest - own @ answer
    before = np.square(rest).sum(axis=0)
    kept = np.square(left).sum(axis=0) > EFFECT_OWN.value * before
    answer = answer / np.where(scale > 0, scale, 1.0)[:, None]
    usable = []
    for effect, columns in members:
        seen = tuple(c for c in columns if kept[c + 1])
        if seen:
            usable.append((effect, seen))
    return Regression(left[:, 0], left[:, 1:], rest[:, 1:], answer[:n_free, 1:], block, usable,
                      whole, n_free)  # fmt: skip


def predicted(data: Experiments, fit: Fit) -> Array:
    """Return the one-step predictions of the output (and current) as columns."""
    return prediction.simulate(data, fit, gain=True)[:, 1:]


def measured(data: Experiments) -> Array:
    """Return what was measured, output (and current) as columns."""
    if data.current.size:
        return np.column_stack([data.output, data.current])
    return data.output[:, None]


def stacked(data: Experiments, fit: Fit, columns: Array) -> Array:
    """Return output and current below each other, in units of their innovations.

    Of long records the sums over so many samples that `ROWS` of each are left, over the root of
    their number: what the effects do is slow, and a sum of errors is as good as they are.
    """
    return whitened(data, fit, _summed(data, columns, together(data))[:, :, None])[0]


def whitened(data: Experiments, fit: Fit, sums: Array) -> list[Array]:
    """Return the same of sums by rows, shape (rows, o, c): c columns."""
    count = np.diff(row_starts(data, together(data)), append=data.size)
    outputs = sums.shape[1]
    unit = np.sqrt(count[:, None] * np.diag(fit.noise)[:outputs])
    return list((sums / unit[:, :, None]).transpose(2, 1, 0).reshape(sums.shape[2], -1))


def together(data: Experiments) -> int:
    """Return how many samples make a row."""
    return max(1, data.size // ROWS)


def own_responses(data: Experiments, fit: Fit, together: int = 1) -> Array:
    """Return the sensitivities to the free coordinates and to each segment's initial state.

    Shape (rows, o, f + s), summed over rows of so many samples.  They are differences over a part
    of what the data leave open: where coordinates hang together, slopes at a point are less apart.
    """
    structure, base = fit.structure, predicted(data, fit)
    # With all others fixed: coordinates that hang together (L/R of next to nothing) leave a
    # motor for other physics within their joint deviations.
    deviation = 1 / np.sqrt(np.maximum(np.diag(fit.information), 1e-300))
    out = []
    for j in range(len(structure.free)):
        step = 0.3 * float(np.clip(deviation[j], 1e-9, 0.05))
        z = fit.z.moved(step * structure.matrix[:, j])
        moved = prediction.once(data, replace(fit, z=z), gain=True)[:, 1:]
        out.append(_summed(data, (moved - base) / step, together))
    begins, segments = row_starts(data, together), len(data.starts) - 1
    columns = own_columns(data, structure)
    if segments > SEGMENTS:
        columns = tuple(c for c in columns if c == 2)
    size = {0: 1e-3, 1: 1e-3 * (1 + np.abs(fit.initial[:, 1]).max()), 2: 1e-3, 3: 1e-3, 4: 1e-3}
    for c in columns:
        initial = fit.initial.copy()
        initial[:, c] += size[c]
        moved = prediction.once(data, replace(fit, initial=initial), gain=True)[:, 1:]
        moved = _summed(data, (moved - base) / size[c], together)
        for a, b in pairwise(data.starts):
            within = (begins >= a) & (begins < b)
            out.append(np.where(within[:, None], moved, 0.0))
    return np.stack(out, axis=2)


def _summed(data: Experiments, columns: Array, together: int) -> Array:
    """Return sums over rows of so many samples, of those that were measured."""
    there = np.isfinite(measured(data))
    known = columns if there.all() else np.where(there, columns, 0.0)
    return np.asarray(np.add.reduceat(known, row_starts(data, together), axis=0))


def answered(data: Experiments, fit: Fit, made: tuple[Array, Array], together: int) -> Array:
    """Return `answers` at a fit."""
    noise = fit.noise_model()
    return answers(data, fit.structure, fit.z, fit.initial, noise, made, together, False)


@dataclass(frozen=True, eq=False)
class Signal:
    """What an effect adds: to the voltage of each section [V], to the output or to the current."""

    voltage: Array | None = None
    output: Array | None = None
    current: Array | None = None  # [A], at the samples

    def within(self, data: Experiments, size: float) -> Experiments:
        """Return experiments in which the model finds the effect as a part of what is given."""
        if self.voltage is not None:
            data = replace(data, hold_value=data.hold_value + size * self.voltage)
        if self.output is not None:
            data = replace(data, output=data.output - size * self.output)
        if self.current is not None:
            data = replace(data, current=data.current - size * self.current)
        return data


def signals(effect: Effect, sections: Motion, samples: Motion) -> list[Signal]:
    """Return what a unit of each regressor of an effect adds.

    A load torque T is a voltage ``-(R T + L dT/dt) / K`` beside a current ``T / K`` that is not the
    model's: ``i - T / K`` then drives a motor without it.
    """
    if effect.place == "output":
        return [Signal(output=s) for s in effect.regressors(samples)]
    if effect.place == "current":
        known = samples.current.size > 0
        return [Signal(current=s) for s in effect.regressors(samples)] if known else []
    at_sections = effect.regressors(sections)
    if effect.place == "voltage" or not samples.current.size:
        return [Signal(voltage=s) for s in at_sections]
    return [
        Signal(
            voltage=s + samples.electric_lag * slope(s, sections.step),
            current=-there / samples.resistance,
        )
        for s, there in zip(at_sections, effect.regressors(samples), strict=True)
    ]


def responses(data: Experiments, fit: Fit, made: Iterable[Signal]) -> Array:
    """Return what a unit of each signal changes in the predictions, shape (rows, o, r).

    As many at a time as a pass carries.
    """
    corrected = bool(fit.gain.any())  # the state follows a wrong measurement, too
    most = carried(data, LANES)
    out: list[Array] = []
    waiting: list[Signal] = []
    places: list[int] = []
    for signal in made:
        if signal.voltage is None and not corrected:
            out.append(_as_it_is(data, signal))
            continue
        places.append(len(out))
        out.append(np.zeros(0))
        waiting.append(signal)
        if len(waiting) == most:
            _put_answers(data, fit, waiting, places, out)
    if waiting:
        _put_answers(data, fit, waiting, places, out)
    return np.stack(out, axis=2)


def carried(data: Experiments, most: int) -> int:
    """Return how many signals a pass carries, of a long record few."""
    return min(most, max(1, ROOM // data.size))


def _put_answers(
    data: Experiments, fit: Fit, waiting: list[Signal], places: list[int], out: list[Array]
) -> None:
    """Put the responses to waiting signals into their places; none waits then."""
    sums = answered(data, fit, _tables(data, waiting), together(data))
    for n, place in enumerate(places):
        out[place] = sums[:, :, n]
    waiting.clear()
    places.clear()


def _tables(data: Experiments, made: Sequence[Signal]) -> tuple[Array, Array]:
    """Return the signals as `Beside` takes them."""
    volts: Array = np.zeros((0, 0))
    added: Array = np.zeros((0, 0, 0))
    if any(s.voltage is not None for s in made):
        none = np.zeros(data.hold_end.size)
        volts = np.array([none if s.voltage is None else s.voltage for s in made])
    if any(s.output is not None or s.current is not None for s in made):
        both, none = [(s.output, s.current) for s in made], np.zeros(data.size)
        added = np.array([[none if x is None else x for x in of] for of in zip(*both, strict=True)])
    return volts, added


def _as_it_is(data: Experiments, signal: Signal) -> Array:
    """Return sums by rows of what is added to the measurements alone."""
    outputs = 1 + (data.current.size > 0)
    added = _tables(data, [signal])[1][:outputs, 0].T
    return _summed(data, added, together(data))


def motions(data: Experiments, fit: Fit, gear: float) -> tuple[Motion, Motion]:
    """Return the free run at the sections' middles and at the samples."""
    run = prediction.simulate(data, fit)
    speed = run[:, 0]
    back = float(fit.structure.internal(fit.z)[0][2])
    angle = data.output if data.kind == ANGLE else np.zeros(data.size)
    if np.isnan(angle).any():
        known = np.flatnonzero(np.isfinite(angle))
        angle = np.interp(np.arange(data.size), known, angle[known])
    voltage = prediction.voltage_at_samples(data)
    at_samples = _motion(data, gear, (data.time, voltage, speed, angle), back, np.diff(data.starts))
    at_samples = replace(
        at_samples,
        output=run[:, 1],
        current=run[:, 2] if data.current.size else np.zeros(0),
        resistance=float(np.exp(fit.z.ln_r)),
        electric_lag=fit.z.electrical_time_constant,
    )
    middle, w, theta = (np.empty(data.hold_end.size) for _ in range(3))
    bounds = [*map(int, data.hold_start[: len(data.starts) - 1]), data.hold_end.size]
    for g, (a, b) in enumerate(zip(data.starts[:-1], data.starts[1:])):
        i, j = bounds[g], bounds[g + 1]
        end = data.hold_end[i:j]
        mid = end - np.diff(end, prepend=min(float(data.time[a]), float(end[0]))) / 2
        middle[i:j] = mid
        w[i:j] = np.interp(mid, data.time[a:b], speed[a:b])
        theta[i:j] = np.interp(mid, data.time[a:b], angle[a:b])
    at_sections = _motion(data, gear, (middle, data.hold_value, w, theta), back, np.diff(bounds))
    return at_sections, at_samples


def _motion(
    data: Experiments,
    gear: float,
    signals: tuple[Array, Array, Array, Array],
    back: float,
    lengths: Array,
) -> Motion:
    time, voltage, speed, angle = signals
    step = np.maximum(np.diff(time, prepend=time[0] - data.step), 0.0)
    step[np.cumsum(lengths)[:-1]] = data.step
    fastest = float(np.abs(speed).max()) or 1.0
    # A motor at rest turns by no rounding error, of which a large coefficient would make an effect.
    speed = np.where(np.abs(speed) > np.finfo(float).eps * fastest, speed, 0.0)
    return Motion(
        share=np.linspace(-1.0, 1.0, time.size, dtype=np.float64),
        step=step,
        voltage=voltage,
        speed=speed,
        angle=angle,
        output=speed,
        drop=voltage - back * speed,
        current=np.zeros(0),
        top=float(np.abs(voltage).max()) or 1.0,
        fastest=fastest,
        gear=gear,
        kind=data.kind,
    )
