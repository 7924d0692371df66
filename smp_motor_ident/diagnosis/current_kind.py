"""What a recorded current is: the armature's, without sign, the supply's, or with an offset.

The winding says ``i = (v - K w) / R + offset`` but for what L adds at steps; without sign it is
the size of that, at the supply of a bridge its product with the duty cycle (power is kept).  Each
is a regression of two coefficients and an offset; the kind is what explains the current best.
"""

from collections.abc import Sequence

import numpy as np

from smp_motor_control.arrays import Array
from smp_motor_ident.diagnosis.data_quality import of_the_winding, offset_of_current
from smp_motor_ident.diagnosis.limits import CURRENT_KIND, FEWEST, METER, REST
from smp_motor_ident.record import Record
from smp_motor_ident.result import NORMAL_95

ARMATURE, UNSIGNED, SUPPLY = "armature", "current_unsigned", "current_of_supply"
OFFSET = "current_offset"  # of the sensor, or of the driver: an equation that is the same for both
ROUNDS = 6
"""In which the sign of the armature's current, and with it the coefficients, settle."""


def current_kind(group: Sequence[Record]) -> str:
    """Return the kind of current of all records together."""
    parts = [of_the_winding(r, r.current) for r in group if r.current is not None]
    v, w, i = (np.concatenate(x) for x in zip(*parts, strict=True)) if parts else ([], [], [])
    if len(i) < FEWEST.value:
        return ARMATURE
    ones = np.ones(len(i))
    rests = {
        ARMATURE: _rest(np.column_stack([v, w, ones]), i)[1],
        UNSIGNED: _unsigned_rest(v, w, i),
        SUPPLY: _rest(np.column_stack([v * v, v * w, ones]), i)[1],
    }
    best = min(rests, key=lambda kind: rests[kind])
    if rests[best] < CURRENT_KIND.value * rests[ARMATURE]:
        return best
    # A coarse encoder's speed hides the equations, and one direction leaves them alike.
    if _one_sign(v, i):
        return UNSIGNED
    return OFFSET if any(map(offset_of_current, group)) else ARMATURE


def _one_sign(v: Array, i: Array) -> bool:
    """Tell whether the current flows forward, and never back, while the motor is driven back.

    Of a motor that is only driven back this is so, too, where the sensor's leads are swapped.
    """
    top = np.abs(v).max()
    back = i[v < -REST.value * top]
    if back.size >= FEWEST.value and v.max() <= REST.value * top:
        return bool(back.mean() > NORMAL_95 * back.std() / np.sqrt(back.size))
    low, high = np.percentile(i, [1, 99])
    if back.size < FEWEST.value or low < -METER.value * high:
        return False
    return float(np.median(back)) > REST.value * float(high)


def _rest(columns: Array, values: Array) -> tuple[Array, float]:
    """Return the coefficients of a regression and the squares that it leaves."""
    answer: Array = np.linalg.lstsq(columns, values, rcond=1e-8)[0].astype(np.float64)
    return answer, float(np.square(values - columns @ answer).sum())


def _unsigned_rest(v: Array, w: Array, i: Array) -> float:
    sign = np.sign(v)
    least = np.inf
    for _ in range(ROUNDS):
        answer, rest = _rest(np.column_stack([sign * v, sign * w, np.ones(len(i))]), i)
        least = min(least, rest)
        sign = np.sign(answer[0] * v + answer[1] * w)
    return least
