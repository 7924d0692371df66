"""Where a motor lies among all motors: the coordinates of the fit, by name.

Every candidate structure is the one motor

    te q' = v(t - delay) - q - K w,    tm w' = q - be w - F(w),    F = Vc sign(w) + load

(te = L/R, tm = R J/K, be = R b/K, q = R i), whose response from voltage to speed is
``w/v = 1 / (a2 s^2 + a1 s + a0)`` with

    a0 = K + be,   a1 = tm + te be,   a2 = te tm.

References
----------
docs/derivations.md, section 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from operator import itemgetter

import numpy as np

from smp_motor_control.arrays import Array


def _coordinate(unit: str, far: float) -> float:
    """Return a coordinate: its unit, and how far it could be from any value at all."""
    made: float = field(default=0.0, metadata={"unit": unit, "far": far})
    return made


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of one motor: the only table of them, in the order of the compiled pass.

    Logarithms of the coefficients of the response, of L/R and R; volts of Coulomb friction in
    both directions and of load; the current's offset; delay, averaging window of the speed and
    mean lag of the current's sensor.
    """

    ln_a0: float = _coordinate("ln(V s/rad)", 10.0)
    ln_a1: float = _coordinate("ln(V s^2/rad)", 10.0)
    ln_a2: float = _coordinate("ln(V s^3/rad)", 10.0)
    ln_te: float = _coordinate("ln(s)", 2.0)
    vc_plus: float = _coordinate("V", 100.0)
    vc_minus: float = _coordinate("V", 100.0)
    load: float = _coordinate("V", 100.0)
    ln_r: float = _coordinate("ln(ohm)", 10.0)
    current_offset: float = _coordinate("A", 100.0)
    delay: float = _coordinate("s", 10.0)
    window: float = _coordinate("s", 10.0)
    current_lag: float = _coordinate("s", 10.0)

    @classmethod
    def of(cls, values: Array) -> Coordinates:
        """Return coordinates from their values in the order of the fields, shape (12,)."""
        return cls(*values.tolist())

    @cached_property
    def array(self) -> Array:
        """Values in the order of the fields, shape (12,), read-only."""
        values = np.array([getattr(self, n) for n in NAMES])
        values.flags.writeable = False
        return values

    def with_(self, **values: float) -> Coordinates:
        """Return the same but for some coordinates."""
        # Asked for at every step of a descent: what `replace` does takes ten times as long.
        every = dict(zip(NAMES, _VALUES(self.__dict__))) | {n: float(v) for n, v in values.items()}
        if len(every) > len(NAMES):
            raise TypeError(f"no coordinates: {', '.join(set(every) - set(NAMES))}")
        made = object.__new__(Coordinates)
        made.__dict__.update(every)
        return made

    def moved(self, step: Array) -> Coordinates:
        """Return the coordinates a step further, shape (12,)."""
        return Coordinates.of(self.array + step)

    def value(self, name: str) -> float:
        """Return a coordinate by its name."""
        return float(getattr(self, name))

    @property
    def a0(self) -> float:
        """Voltage per speed of a motor that runs steadily [V s/rad]."""
        return _exp(self.ln_a0)

    @property
    def a1(self) -> float:
        """Voltage per acceleration [V s^2/rad]."""
        return _exp(self.ln_a1)

    @property
    def a2(self) -> float:
        """Voltage per jerk [V s^3/rad]."""
        return _exp(self.ln_a2)

    @property
    def dc_gain(self) -> float:
        """Speed per voltage of a motor that runs steadily [rad/s/V]."""
        return _exp(-self.ln_a0)

    @property
    def time_constant(self) -> float:
        """Sum of both lags, ``a1/a0`` [s]."""
        return _exp(self.ln_a1 - self.ln_a0)

    @property
    def second_lag(self) -> float:
        """The shorter lag where it is far the shorter, ``a2/a1`` [s]."""
        return _exp(self.ln_a2 - self.ln_a1)

    @property
    def electrical_time_constant(self) -> float:
        """L/R [s]."""
        return _exp(self.ln_te)

    def with_second_lag(self, lag: float) -> Coordinates:
        """Return a motor with another second lag [s], all of it the winding's (no damping)."""
        ln_a2 = self.ln_a1 + float(np.log(lag))
        return self.with_(ln_a2=ln_a2, ln_te=ln_a2 - self.ln_a1)

    def undamped(self) -> Coordinates:
        """Return the motor of the same response whose friction is Coulomb's alone (be = 0)."""
        return self.with_(ln_te=self.ln_a2 - self.ln_a1)

    def with_friction(self, volts: float) -> Coordinates:
        """Return the same motor under another Coulomb friction, alike in both directions [V]."""
        return self.with_(vc_plus=volts, vc_minus=volts)


NAMES = tuple(f.name for f in fields(Coordinates))
_VALUES = itemgetter(*NAMES)
LOGARITHMS = tuple(n for n in NAMES if n.startswith("ln_"))
PLAUSIBLE = 1 / np.square([float(f.metadata["far"]) for f in fields(Coordinates)])
"""Inverse squares of how far each coordinate could be from any value at all, shape (12,)."""


STANDS_FOR = {
    "ln_a0": "dc_gain",
    "ln_a1": "time_constant",
    "ln_a2": "time_constant_product",
    "ln_te": "inductance",
    "vc_plus": "static_voltage",
    "vc_minus": "static_voltage_reverse",
    "load": "load_voltage",
    "ln_r": "resistance",
    "window": "averaging_window",
}
"""The reported quantity that a coordinate moves most, where it has another name."""


def place(name: str) -> int:
    """Return where a coordinate stands in arrays over all of them."""
    return NAMES.index(name)


def direction(**weights: float) -> Array:
    """Return a vector in the space of the coordinates, from its parts by name, shape (12,)."""
    vector: Array = np.zeros(len(NAMES))
    for name, weight in weights.items():
        vector[place(name)] = weight
    return vector


def _exp(x: float) -> float:
    """Return e^x, infinite where it overflows."""
    return math.inf if x > 709.0 else float(np.exp(x))


RINGS = math.log(0.25)


def lag_share(log_ratio: float) -> float:
    """Return c of two lags T and cT, of which ``a2 a0 / a1^2 = c / (1 + c)^2``, at most 1."""
    root = math.sqrt(1 - 4 * math.exp(min(log_ratio, RINGS)))
    return (1 - root) / (1 + root)
