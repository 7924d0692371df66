"""Starting values: state-variable filters, linear least squares, one instrumental step.

Derivation: docs/derivations.md, section 10.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import METER
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.likelihood.regression import (
    filtered,
    friction_sign,
    instrumental,
    search,
    solved,
)
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.physical import from_physical

GRIDS = 8  # segments that are looked at, those that moved most


@dataclass(frozen=True, eq=False)
class FilteredData:
    """The regressions on some experiments, as `structure.Structure.guesses` asks for them."""

    data: Experiments

    def speed(self, order: int, frictions: tuple[bool, ...]) -> list[Coordinates]:
        """Return motors of an order from voltage and speed, with friction or without."""
        return speed_candidates(self.data, order, frictions=frictions)

    def current(self) -> list[Coordinates]:
        """Return motors from voltage, speed and current."""
        return current_candidates(self.data)


@dataclass(frozen=True, eq=False)
class Uniform:
    """One segment on an even grid: mean voltage per interval, output and current at its end."""

    step: float
    voltage: Array
    output: Array
    current: Array | None


def resample(data: Experiments, g: int, most: int = 8_000) -> Uniform | None:
    """Put segment ``g`` on an even grid (for the start only)."""
    a, b = int(data.starts[g]), int(min(data.starts[g + 1], data.starts[g] + most))
    t, y = data.time[a:b], data.output[a:b]
    ok = np.isfinite(y)
    if ok.sum() < 12:
        return None
    steps = np.diff(t)
    if data.plain and ok.all() and np.abs(steps - data.step).max() < 1e-6 * data.step:
        there = data.current[a:b] if data.current.size else None
        if there is None or np.isfinite(there).all():
            return Uniform(data.step, data.hold_value[a:b], y, there)
    step = float(np.median(steps))
    grid = np.arange(t[0], t[-1] + 0.5 * step, step)
    grid = grid[grid <= t[-1] + 1e-9 * step]
    last = int(data.hold_start[g + 1]) if g + 2 < len(data.starts) else len(data.hold_end)
    first = int(data.hold_start[g])
    ends = data.hold_end[first:last]
    last = first + int(np.searchsorted(ends, t[-1])) + 1
    ends, values = data.hold_end[first:last], data.hold_value[first:last]
    charge = np.concatenate([[0.0], np.cumsum(values[1:] * np.diff(ends))])
    mean = np.diff(np.interp(grid, ends, charge)) / step
    voltage = np.concatenate([[values[0]], mean])
    current = None
    if data.current.size:
        i = data.current[a:b]
        if np.isfinite(i).sum() > 12:
            current = np.interp(grid, t[np.isfinite(i)], i[np.isfinite(i)])
    return Uniform(step, voltage, np.interp(grid, t[ok], y[ok]), current)


def cutoffs(data: Experiments, count: int = 7) -> Array:
    """Return filter cut-offs [rad/s] spread over what the sampling can show."""
    high = 1.0 / data.step
    low = max(2.0, high / 300)
    return np.asarray(np.geomspace(low, high, count), dtype=np.float64)


def speed_candidates(
    data: Experiments,
    order: int,
    lag: int = 0,
    frictions: tuple[bool, ...] = (True, False),
    bands: Array | None = None,
) -> list[Coordinates]:
    """Return candidate coordinates from voltage and the mechanical output.

    Least squares on ``v = a2 w'' + a1 w' + a0 w + Vc sign(w)`` after filtering, for several
    cut-offs, with and without friction, each refined by one instrumental-variable step.
    """
    out: list[Coordinates] = []
    for view in _views(data):
        grids = [_late(u, lag) for u in view]
        voltage = np.concatenate([u.voltage for u in grids])
        output = np.concatenate([u.output for u in grids])
        bounds = np.cumsum([0, *(len(u.output) for u in grids)])
        steps = np.array([u.step for u in grids])
        bands = cutoffs(data, 7 if lag == 0 else 4) if bands is None else bands
        angle = data.kind == ANGLE
        for friction in frictions:
            for theta in search(voltage, output, bounds, steps, bands, order, angle, friction):
                out.append(_to_z(theta, order))
    return out


def _views(data: Experiments) -> list[list[Uniform]]:
    """Return the segments that move most; where no voltage changes, also as steps from rest.

    Filters swallow what happens in the first samples: rest before them keeps it.
    """
    grids = [u for g in range(len(data.starts) - 1) if (u := resample(data, g)) is not None]
    if not grids:
        return []
    grids = sorted(grids, key=lambda u: -float(np.ptp(u.output)))[:GRIDS]
    if any(np.ptp(u.voltage[1:]) > METER.value * np.abs(u.voltage).max() for u in grids):
        return [grids]
    return [grids, [_from_rest(u, data.kind == ANGLE) for u in grids]]


def _from_rest(u: Uniform, angle: bool) -> Uniform:
    """Put rest before a voltage that is switched on in the first row."""
    still = np.zeros(len(u.voltage) // 2)
    where = still + (u.output[0] if angle else 0.0)
    current = None if u.current is None else np.concatenate((still, u.current))
    voltage = np.concatenate((still, [0.0], u.voltage[1:]))
    return Uniform(u.step, voltage, np.concatenate((where, u.output)), current)


def _late(u: Uniform, lag: int) -> Uniform:
    if lag == 0 or lag >= len(u.voltage):
        return u
    voltage = np.concatenate([np.full(lag, u.voltage[0]), u.voltage[:-lag]])
    return Uniform(u.step, voltage, u.output, u.current)


def _to_z(theta: Array, order: int) -> Coordinates:
    """Return the coordinates of a0, a1 (, a2) and the volts of friction."""
    names = ("ln_a0", "ln_a1", "ln_a2")[: order + 1]
    z = Coordinates(**dict(zip(names, map(float, np.log(theta[: order + 1])), strict=True)))
    return (z.undamped() if order == 2 else z).with_friction(float(theta[-1]))


def current_candidates(data: Experiments) -> list[Coordinates]:
    """Return candidate coordinates from voltage, current and the mechanical output.

    The electric equation ``v = L i' + R i + K w`` and the mechanical
    ``K i = J w' + b w + Tc sign(w)`` are two linear regressions, filtered.
    """
    out: list[Coordinates] = []
    for view, cutoff in product(_views(data), cutoffs(data)):
        electric, mechanic = np.zeros((4, 7)), np.zeros((4, 7))
        for u in view:
            if u.current is not None:
                _both_equations(u, cutoff, data.kind == ANGLE, electric, mechanic)
        inductance, r, k = solved(electric)[:3]
        if not (r > 0 and k > 0):
            continue
        inductance = inductance if inductance > 0 else 1e-3 * r * data.step
        # One way, friction and the current's offset are one column: the second is without it.
        bare = np.delete(np.delete(mechanic, SIGN, 0), SIGN, 1)
        for slope, damping, drag in (solved(mechanic)[:3], (*solved(bare)[:2], 0.0)):
            if slope > 0:
                b, tc = k * max(damping, 0.0), k * max(drag, 0.0)
                out.append(from_physical(r, inductance, k, k * slope, b, tc))
    return out


SIGN = 2
"""Place of the direction's sign among the columns of the mechanical equation."""


def _both_equations(
    u: Uniform, cutoff: float, angle: bool, electric: Array, mechanic: Array
) -> None:
    """Add one grid to the sums of both regressions."""
    assert u.current is not None
    extra = 1 if angle else 0
    n = 1 + extra
    rest = 0.0 if angle else float(u.output[0])
    f = filtered(u.output - u.output[0], cutoff, u.step, n)
    speed, slope = f[extra] + rest, f[extra + 1]
    i, di = filtered(u.current, cutoff, u.step, n)[:2]
    held = u.voltage.copy()  # at an instant: half-way between two held intervals
    held[:-1] = 0.5 * (held[:-1] + held[1:])
    v = filtered(held, cutoff, u.step, n)[0]
    slow = filtered(u.output - u.output[0], min(cutoff, 0.3 / u.step), u.step, n)[extra]
    sign = filtered(friction_sign(slow + rest), cutoff, u.step, n)[0]
    one = np.ones_like(i)
    skip = min(int(4 / (cutoff * u.step)) + 2, len(v) // 3)
    for columns, right, sums in (
        (np.stack([di, i, speed, one]), v, electric),
        (np.stack([slope, speed, sign, one]), i, mechanic),
    ):
        instrumental(columns, columns, right, skip, len(v), sums)
