# SPDX-License-Identifier: Apache-2.0
"""Identify a motor with other packages, as their documentation recommends."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from known_motors import independent
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter

from smp_motor_control.motor.parameters import PHYSICAL, MotorParameters
from smp_motor_ident.record import Record

GUESS = (0.1, 1e-2, 1e-4)
"""a0 [V s/rad], a1 [V s^2/rad], a2 [V s^3/rad] of the start: a motor that turns at 120 rad/s at
12 V with time constants of about 0.1 and 0.01 s, round numbers, 2.5 to 6 times off here."""
SMOOTH = 1.0  # rad/s within which a smooth friction changes sign
OPTIMISED = ("-O3", "-march=native")
STEPS = 10  # of Runge-Kutta per sample, as in CasADi's example


@dataclass(frozen=True)
class Peer:
    """A way to fit: its title, the module it needs, and how much faster one wants to be."""

    title: str
    module: str
    fit: Callable[[Record], np.ndarray]
    goal: int = 0
    friction: bool = False
    quick: bool = False


set_up = [0.0, 0.0]
"""Wall and processor seconds that programs have spent on building and compiling a problem."""


@contextlib.contextmanager
def _setting_up() -> Iterator[None]:
    """Count the time inside as set-up."""
    begun, spent = time.perf_counter(), time.process_time()
    yield
    set_up[0] += time.perf_counter() - begun
    set_up[1] += time.process_time() - spent


def cost(record: Record, x: np.ndarray) -> float:
    """Return the sum of squared errors of a motor's speed, simulated independently from rest.

    Parameters
    ----------
    record : Record
        Voltage and speed.
    x : ndarray, shape (3,) or (4,)
        ln a0, ln a1, ln a2 and perhaps the volts of friction.

    Returns
    -------
    float
        NaN where ``x`` is.
    """
    if not np.all(np.isfinite(x)):
        return float("nan")
    a0, a1, a2 = np.exp(x[:3])
    motor = MotorParameters.from_combinations(
        dc_gain=1 / a0, time_constant=a1 / a0, time_constant_product=a2 / a0,
        static_voltage=x[3] if len(x) > 3 else 0.0,
    )  # fmt: skip
    values = [getattr(motor, name) for name in PHYSICAL]
    still = np.zeros(len(record))
    speed = independent.simulate(record.time, record.voltage, *values, still, 20)[:, 1]
    return float(np.square(record.velocity - speed).sum())


def _ahead(record: Record) -> np.ndarray:
    """Return the voltage held over the interval that begins at each sample."""
    return np.concatenate([record.voltage[1:], record.voltage[-1:]])


def with_lfilter(record: Record) -> np.ndarray:
    """Fit by an expert's ten lines: exact discretisation, lfilter, finite differences."""
    h, v, y = record.sample_time, _ahead(record), record.velocity

    def residual(x: np.ndarray) -> np.ndarray:
        a0, a1, a2 = np.exp(x)
        num, den, _ = cont2discrete(([1.0], [a2, a1, a0]), h)
        return lfilter(num.ravel(), den, v) - y

    return least_squares(residual, np.log(GUESS), x_scale="jac").x


def with_control(record: Record) -> np.ndarray:
    """Fit by python-control's simulation under least_squares."""
    import control

    t, y, v = record.time, record.velocity, _ahead(record)

    def residual(x: np.ndarray) -> np.ndarray:
        a0, a1, a2 = np.exp(x)
        system = control.c2d(control.ss(control.tf([1.0], [a2, a1, a0])), record.sample_time)
        return control.forced_response(system, t, v).outputs - y

    return least_squares(residual, np.log(GUESS), x_scale="jac").x


def _casadi_error(record: Record, friction: bool, steps: int):
    """Return symbols of the parameters over their guess, and of the error of the speed."""
    import casadi as ca

    n = 4 if friction else 3
    x, u, p = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("p", n)
    drag = p[3] * ca.tanh(x[1] / SMOOTH) if friction else 0
    # q = R i: te q' = u - q - a0 w, a1 w' = q - friction, te = a2/a1.
    rate = ca.Function(
        "rate",
        [x, u, p],
        [ca.vertcat((u - x[0] - p[0] * x[1]) * p[1] / p[2], (x[0] - drag) / p[1])],
    )
    h = record.sample_time / steps
    k1 = rate(x, u, p)
    k2 = rate(x + h / 2 * k1, u, p)
    k3 = rate(x + h / 2 * k2, u, p)
    k4 = rate(x + h * k3, u, p)
    one_step = ca.Function("one_step", [x, u, p], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    state = x
    for _ in range(steps):
        state = one_step(state, u, p)
    one_sample = ca.Function("one_sample", [x, u, p], [state])
    count = len(record) - 1
    all_samples = one_sample.mapaccum("all_samples", count)
    scaled = ca.MX.sym("q", n)
    guess = ca.DM([*GUESS, 0.1] if friction else list(GUESS))
    path = all_samples(
        ca.DM.zeros(2), ca.DM(record.voltage[1:]).T, ca.repmat(scaled * guess, 1, count)
    )
    return scaled, np.asarray(guess).ravel(), ca.DM(record.velocity[1:]) - path[1, :].T


def with_casadi(
    record: Record, friction: bool = False, jit: bool = True, flags: tuple[str, ...] = ()
) -> np.ndarray:
    """Fit as CasADi's example of system identification does: Gauss-Newton Hessian, IPOPT.

    The example compiles the functions where there is a compiler; that is not counted.

    References
    ----------
    CasADi, docs/examples/python/sysid.py (single shooting).
    """
    import casadi as ca

    options = {"jit": True, "compiler": "shell"} if jit and ca.Importer.has_plugin("shell") else {}
    if options and flags:
        options["jit_options"] = {"flags": list(flags)}
    with _setting_up():
        q, guess, error = _casadi_error(record, friction, STEPS)
        jacobian = ca.jacobian(error, q)
        sigma = ca.MX.sym("sigma")
        hessian = ca.Function(
            "nlp_hess_l",
            {"x": q, "lam_f": sigma, "hess_gamma_x_x": sigma * ca.triu(jacobian.T @ jacobian)},
            ["x", "p", "lam_f", "lam_g"],
            ["hess_gamma_x_x"],
            options,
        )
        quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
        problem = {"x": q, "f": 0.5 * ca.dot(error, error)}
        solver = ca.nlpsol("solver", "ipopt", problem, {"hess_lag": hessian, **quiet, **options})
    found = solver(x0=np.ones(len(guess)), lbx=1e-6)
    x = np.asarray(found["x"]).ravel() * guess
    return np.append(np.log(x[:3]), x[3:])


def with_casadi_by_hand(record: Record) -> np.ndarray:
    """Fit as fast as we could write it with CasADi: one step a sample, own Gauss-Newton in logs."""
    import casadi as ca

    with _setting_up():
        q, guess, error = _casadi_error(record, False, 1)
        both = ca.Function("both", [q], [error, ca.jacobian(error, q)])
    x, lam = np.zeros(3), 1e-3
    e, jac = (np.array(m) for m in both(np.exp(x)))
    for _ in range(40):
        jac = jac * np.exp(x)
        normal = jac.T @ jac
        step = np.linalg.solve(normal + lam * np.diag(np.diag(normal)), -(jac.T @ e).ravel())
        new_e, new_jac = (np.array(m) for m in both(np.exp(x + step)))
        if np.isfinite(new_e).all() and (new_e**2).sum() <= (e**2).sum():
            small = (e**2).sum() - (new_e**2).sum() < 1e-9 * (e**2).sum()
            x, e, jac, lam = x + step, new_e, new_jac, lam / 10
            if small:
                break
        else:
            jac, lam = jac / np.exp(x), lam * 10
    return x + np.log(guess)


def with_sippy(record: Record) -> np.ndarray:
    """Fit SIPPY's output-error model of second order, and take it back to continuous time."""
    from sippy_unipi import system_identification

    h = record.sample_time
    model = system_identification(
        record.velocity, _ahead(record), "OE", OE_orders=[2, 2, 0], tsample=h
    )
    num, den = np.ravel(model.G.num[0][0]), np.ravel(model.G.den[0][0])
    poles = np.log(np.roots(den[:3]).astype(complex)) / h
    gain = num.sum() / den.sum()
    a0 = 1 / gain
    a2 = a0 / np.real(np.prod(poles))
    return np.log([a0, -np.real(poles.sum()) * a2, a2])


PEERS = {
    "lsq": Peer("lfilter + least_squares", "scipy", with_lfilter, 5, quick=True),
    "control": Peer("python-control + least_squares", "control", with_control, 1000),
    "sippy": Peer("SIPPY OE", "sippy_unipi", with_sippy, 1000),
    "casadi": Peer("CasADi Gauss-Newton, as in its example", "casadi", with_casadi, 3000),
    "o3": Peer("CasADi the same, with -O3 -march=native", "casadi",
               lambda record: with_casadi(record, flags=OPTIMISED)),
    "virtual": Peer("CasADi the same, not compiled", "casadi",
                    lambda record: with_casadi(record, jit=False)),
    "byhand": Peer("CasADi, our best by hand, not compiled", "casadi", with_casadi_by_hand),
    "friction": Peer("CasADi Gauss-Newton, smooth friction", "casadi",
                     lambda record: with_casadi(record, True), 300, True),
    "frictiono3": Peer("CasADi the same, with -O3 -march=native", "casadi",
                       lambda record: with_casadi(record, True, flags=OPTIMISED), 0, True),
}  # fmt: skip
