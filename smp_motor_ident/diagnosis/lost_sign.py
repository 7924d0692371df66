"""A command or a speed that has lost its sign: a size beside a motion, or a voltage, of both."""

from collections.abc import Sequence

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.limits import BACKWARD, HALF_EXPLAINED
from smp_motor_ident.diagnosis.signs import lagged
from smp_motor_ident.errors import SignalError
from smp_motor_ident.record import Record

RUNS = 50  # of a record
LAGS = 8  # between a sample and a tenth of the record, of what the motor makes of the voltage


def lost_sign(records: Sequence[Record], speeds: Sequence[Array], where: str) -> None:
    """Refuse sizes that stand where a sign decides."""
    lowest = min(float(np.nanmin(r.voltage)) for r in records)
    ways = np.concatenate([_ways(w) for w in speeds])
    way, back = float(np.abs(ways).sum()), -float(np.minimum(ways, 0.0).sum())
    if lowest >= 0 and back > BACKWARD.value * way and way - back > BACKWARD.value * way:
        raise SignalError(
            f"{where}: the voltage is never negative, though {back / way:.0%} of the way is "
            "backwards: it has no sign; map its direction with direction=COLUMN, or record a "
            "signed command"
        )
    if all(_size_of(r) for r in records):
        raise SignalError(
            f"{where}: velocity is never negative although the voltage is, and follows its size: "
            "it has no sign; record a signed speed, the encoder's counts or a direction"
        )


def _ways(speed: Array) -> Array:
    """Return the ways of runs of samples, in which a sensor's noise is next to nothing."""
    starts = np.unique(np.linspace(0, speed.size, RUNS, endpoint=False).astype(int))
    return np.asarray(np.add.reduceat(np.nan_to_num(speed), starts))


def _size_of(record: Record) -> bool:
    """Tell whether a speed is the size of what the motor makes of its voltage."""
    speed, volts = record.velocity, record.voltage
    if speed is None or record.count is not None or record.position is not None:
        return False
    if np.nanmin(speed) < 0 or not volts.min() < 0 < volts.max():
        return False
    known = np.isfinite(speed)
    found = []
    for lag in np.geomspace(1.0, max(len(record) / 10, 2.0), LAGS):
        made = lagged(volts, float(lag))[known]
        found.append([_share(x, speed[known]) for x in (made, np.abs(made))])
    signed, size = np.max(found, axis=0)
    return bool(size > HALF_EXPLAINED.value and signed < HALF_EXPLAINED.value * size)


def _share(x: Array, y: Array) -> float:
    """Return which share of a variance a line explains."""
    x, y = x - x.mean(), y - y.mean()
    both = float((x @ x) * (y @ y))
    return float(x @ y) ** 2 / both if both > 0 else 0.0
