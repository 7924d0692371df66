"""Cold estimation of one linear motor against what people write today, on the same data.

Usage: python benchmarks/speed.py [--samples 60000] [--peers lsq,control,sippy,casadi] [--growth]
Peers are optional: pip install -r benchmarks/requirements-peers.txt
"""

from __future__ import annotations

import argparse
import importlib.util
import resource
import time
from collections.abc import Callable

import numpy as np
from known_motors import TABLE_1, recording, table
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter

from smp_motor_ident.cold import cold_fit
from smp_motor_ident.descent import Options
from smp_motor_ident.estimate import estimate
from smp_motor_ident.experiments import prepare
from smp_motor_ident.models import Structure


def ours(record) -> np.ndarray:
    """Return ln a0, ln a1, ln a2 from cold: the fit alone."""
    fit = cold_fit(prepare([record], False), Structure("speed", friction="none"), Options())
    return fit.z[:3]


def whole(record) -> np.ndarray:
    """Return the same from `estimate`: screening, choice, intervals, validation included."""
    e = estimate(record, "second_order")
    gain, tau, product = (e.value(n) for n in ("dc_gain", "time_constant", "time_constant_product"))
    return np.log([1 / gain, tau / gain, product / gain])


def any_model(record) -> np.ndarray:
    """Return the same, the order of the model being chosen too."""
    e = estimate(record)
    gain, tau, product = (e.value(n) for n in ("dc_gain", "time_constant", "time_constant_product"))
    return np.log([1 / gain, tau / gain, product / gain])


def with_lfilter(record) -> np.ndarray:
    """Return an expert's ten lines: exact discretisation, lfilter, finite differences."""
    h, v, y = record.sample_time, record.voltage, record.velocity
    v = np.concatenate([v[1:], v[-1:]])

    def residual(x: np.ndarray) -> np.ndarray:
        a0, a1, a2 = np.exp(x)
        num, den, _ = cont2discrete(([1.0], [a2, a1, a0]), h)
        return lfilter(num.ravel(), den, v) - y

    return least_squares(residual, np.log([0.03, 1e-3, 1e-5]), x_scale="jac").x


def with_control(record) -> np.ndarray:
    """Return python-control's simulation under least_squares."""
    import control

    t, y = record.time, record.velocity
    v = np.concatenate([record.voltage[1:], record.voltage[-1:]])

    def residual(x: np.ndarray) -> np.ndarray:
        a0, a1, a2 = np.exp(x)
        system = control.c2d(control.ss(control.tf([1.0], [a2, a1, a0])), record.sample_time)
        return control.forced_response(system, t, v).outputs - y

    return least_squares(residual, np.log([0.03, 1e-3, 1e-5]), x_scale="jac").x


def with_casadi(record) -> np.ndarray:
    """Return CasADi's Gauss-Newton on a Runge-Kutta simulation."""
    import casadi as ca

    h, n = record.sample_time, len(record)
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 3)
    a = ca.exp(p)
    rate = ca.Function("f", [x, u, p], [ca.vertcat(x[1], (u - a[0] * x[0] - a[1] * x[1]) / a[2])])
    k1 = rate(x, u, p)
    k2 = rate(x + h / 2 * k1, u, p)
    k3 = rate(x + h / 2 * k2, u, p)
    k4 = rate(x + h * k3, u, p)
    step = ca.Function("F", [x, u, p], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    q = ca.MX.sym("q", 3)
    path = step.mapaccum(n - 1)(ca.DM.zeros(2), ca.DM(record.voltage[1:]).T, q)
    error = path[0, :].T - ca.DM(record.velocity[1:])
    both = ca.Function("r", [q], [error, ca.jacobian(error, q)])
    z = np.log([0.04, 1.5e-3, 2.5e-5])
    for _ in range(8):
        e, jac = (np.array(m) for m in both(z))
        z = z - np.linalg.lstsq(jac, e, rcond=None)[0].ravel()
    return z


def with_sippy(record) -> np.ndarray:
    """Return SIPPY's output-error model (its discrete coefficients; no a0..a2)."""
    from sippy_unipi import system_identification

    system_identification(
        record.velocity, record.voltage, "OE", OE_orders=[2, 2, 1], tsample=record.sample_time
    )
    return np.full(3, np.nan)


PEERS: dict[str, tuple[str, Callable]] = {
    "lsq": ("scipy", with_lfilter),
    "control": ("control", with_control),
    "casadi": ("casadi", with_casadi),
    "sippy": ("sippy_unipi", with_sippy),
}


def best_of(call: Callable, record, repeats: int) -> tuple[float, np.ndarray]:
    """Return the shortest processor time (of all threads) and the answer."""
    spent = []
    for _ in range(repeats):
        begun = time.process_time()
        answer = call(record)
        spent.append(time.process_time() - begun)
    return min(spent), answer


def growth() -> None:
    """Print time and memory against the number of samples."""
    rows = []
    for n in (10_000, 100_000, 1_000_000, 10_000_000):
        record, z = recording(
            TABLE_1["rear_right"], current=False, seconds=n / 1000, rate=1000.0, substeps=4
        )
        size = sum(a.nbytes for a in (record.time, record.voltage, record.count)) / 2**20
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        spent, x = best_of(ours, record, 1)
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        rows.append(
            (
                n,
                f"{spent:.2f} s",
                f"{1e9 * spent / n:.0f} ns",
                f"{size:.0f} MiB",
                f"{max(0.0, after - before):.0f} MiB",
                f"{np.abs(x - z[:3]).max():.1e}",
            )
        )
        print(rows[-1], flush=True)
    head = ("samples", "cold fit", "per sample", "record", "more at its peak", "error of ln a")
    print("\n" + table(head, rows))


def main() -> None:
    """Run the comparison and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=60_000)
    parser.add_argument("--peers", default="lsq,control,casadi,sippy")
    parser.add_argument("--growth", action="store_true")
    args = parser.parse_args()
    if args.growth:
        growth()
        return
    seconds = args.samples / 1000
    record, z = recording(
        TABLE_1["rear_right"], current=False, seconds=seconds, rate=1000.0, counts=False
    )
    rng = np.random.default_rng(0)
    noisy = record.velocity + 2.0 * rng.standard_normal(len(record))
    record = type(record)("motor", record.time, record.voltage, velocity=noisy)
    begun = time.perf_counter()
    ours(record)
    first = time.perf_counter() - begun
    base, x = best_of(ours, record, 5)
    rows = [("this project, the fit", f"{base:.4f}", "1", f"{np.abs(x - z[:3]).max():.1e}")]
    title = {"lsq": "lfilter + least_squares", "control": "python-control + least_squares",
             "casadi": "CasADi Gauss-Newton", "sippy": "SIPPY OE"}  # fmt: skip
    for what, call in (("estimate(), second_order", whole), ("estimate(), auto", any_model)):
        call(record)
        spent, x = best_of(call, record, 3)
        rows.append((f"this project, {what}", f"{spent:.3f}", f"{spent / base:.0f}",
                     f"{np.abs(x - z[:3]).max():.1e}"))  # fmt: skip
    for name in args.peers.split(","):
        module, call = PEERS[name]
        if importlib.util.find_spec(module) is None:
            print(f"{name}: not installed, left out")
            continue
        spent, x = best_of(call, record, 1)
        rows.append((title[name], f"{spent:.3f}",
                     f"{spent / base:.0f}", f"{np.abs(x - z[:3]).max():.1e}"))  # fmt: skip
        print(rows[-1], flush=True)
    print("\n" + table(("program", "processor seconds", "times ours", "error of ln a"), rows))
    print(f"\n{args.samples} samples; first call {first:.1f} s with compilation or its cache")


if __name__ == "__main__":
    main()
