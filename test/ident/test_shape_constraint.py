"""A descent goes on along the edge of what a motor can be, and where L/R is next to nothing."""

from __future__ import annotations

import numpy as np
import pytest

from smp_motor_ident.diagnosis.limits import MOST_FRICTION
from smp_motor_ident.estimation import shape_constraint
from smp_motor_ident.estimation.fit import Start, solve
from smp_motor_ident.likelihood.experiments import prepare
from smp_motor_ident.model.coordinates import Coordinates
from smp_motor_ident.model.physical import from_physical
from smp_motor_ident.model.second_order import internal
from smp_motor_ident.model.structures import Electromechanical, SecondOrder
from smp_motor_ident.record import Record

SHAPED = SecondOrder(shape=True)
MOTOR = from_physical(2.0, 4e-3, 0.05, 2e-4, 1e-6, 0.01)


def driven(z: Coordinates = MOTOR, rate: float = 2000.0, seconds: float = 3.0) -> Record:
    """A square wave on a motor next to all of whose damping is back-EMF; noisy angle, current."""
    rng = np.random.default_rng(5)
    t = np.arange(int(seconds * rate)) / rate
    v = np.where(np.sin(2 * np.pi * 1.1 * t) >= 0, 12.0, -12.0)
    (te, tm, k, be), vc = internal(z)[0][:4], z.vc_plus
    q = w = angle = 0.0
    out, amps, fine = np.empty(t.size), np.empty(t.size), 2.5e-5
    for n in range(t.size):
        out[n], amps[n] = angle, q / np.exp(z.ln_r)
        for _ in range(round(1 / rate / fine)):  # semi-implicit Euler
            q += fine / te * (v[min(n + 1, t.size - 1)] - q - k * w)
            w += fine / tm * (q - be * w - vc * np.sign(w))
            angle += fine * w
    amps += 0.02 * rng.standard_normal(t.size)
    return Record("motor", t, v, amps, position=out + 0.02 * rng.standard_normal(t.size))


@pytest.mark.parametrize("share", [0.0, MOST_FRICTION.value])
def test_from_either_edge_a_descent_finds_the_bottom(share):
    data = prepare([driven()], False)
    start = MOTOR.with_(ln_a0=MOTOR.ln_a0 + 0.02, ln_a2=MOTOR.ln_a2 - 0.03)
    start = start.with_(ln_te=shape_constraint.edge(start, share)[0])
    noise = np.diag([4e-4, 1.0])

    def bottom(z):
        return solve(data, SHAPED, Start(SHAPED.complete(z), data.initial, noise))

    found, true = bottom(start), bottom(MOTOR)
    assert found.converged
    assert found.deviance < true.deviance + 4.0  # two deviations of a chi-square


def test_an_inductance_far_below_the_sampling_is_no_place_to_stay():
    fast = from_physical(2.0, 1e-3, 0.05, 2e-4, 1e-5, 0.01)
    data = prepare([driven(fast, 100.0, 10.0)], True)
    whole = Electromechanical()
    noise = np.diag([4e-4, 4e-4])
    start = fast.with_(ln_a2=fast.ln_a2 + np.log(0.1), ln_te=fast.ln_te + np.log(0.1))

    def bottom(z):
        return solve(data, whole, Start(whole.complete(z), data.initial, noise))

    found, true = bottom(start), bottom(fast)
    assert found.converged
    assert found.deviance < true.deviance + 1.0  # the same bottom, to a deviation


def test_the_edges_are_where_damping_is_nothing_and_all_but_a_fiftieth():
    for share in (0.0, MOST_FRICTION.value):
        z = MOTOR.with_(ln_te=shape_constraint.edge(MOTOR, share)[0])
        te, _, k, be = internal(z)[0][:4]
        assert be / (k + be) == pytest.approx(share, abs=1e-9)  # rounding of a difference
        assert shape_constraint.passed(z) is None
        assert te > 0


def test_the_gradient_of_an_edge_is_its_slope():
    for share in (0.0, MOST_FRICTION.value):
        z = MOTOR.with_(ln_te=shape_constraint.edge(MOTOR, share)[0])
        for name in ("ln_a0", "ln_a1", "ln_a2"):
            moved = z.with_(**{name: z.value(name) + 1e-6})
            slope = (shape_constraint.edge(moved, share)[0] - z.ln_te) / 1e-6
            # a forward difference over 1e-6 of a smooth function
            assert shape_constraint.edge(z, share)[1][name] == pytest.approx(slope, abs=1e-4)


def test_the_edge_of_a_winding_too_short_for_rounding_is_found():
    # a1^2 - 4 share a0 a2 rounds to a1^2 here; the shorter lag at the edge is a2 / a1.
    z = Coordinates(*np.log([0.05, 2e-3, 1e-23, 5e-21]))
    there = shape_constraint.edge(z, 0.98)
    assert there is not None
    assert there[0] == pytest.approx(np.log(z.second_lag), abs=1e-9)
