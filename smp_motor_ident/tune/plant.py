r"""The motor as a sampled loop sees it: exact zero-order hold with a delay of any length.

A batch of ``n`` motors :math:`e^{-sD} / (a_2 s^2 + a_1 s + a_0)` is sampled at once, so that
one motor and a thousand draws of an uncertain one are the same few array operations.
Everything here is at the motor shaft.

References
----------
.. [1] K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, 3rd ed. (1997), section 2.3:
   sampling of systems with time delay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smp_motor_ident.errors import DesignError
from smp_motor_ident.result import Estimate
from smp_motor_ident.tune.arrays import Array, Complex
from smp_motor_ident.tune.loop import Loop

PHYSICAL = ("resistance", "inductance", "motor_constant", "inertia", "viscous_friction")


@dataclass(frozen=True, eq=False)
class Motors:
    """Combinations that fix the response from voltage to speed, for a batch of motors.

    Attributes
    ----------
    a0, a1, a2 : ndarray, shape (n,)
        Coefficients [V s/rad], [V s^2/rad], [V s^3/rad] of ``a2 s^2 + a1 s + a0``.
    delay : ndarray, shape (n,), [s]
        The motor's own delay, from applied voltage to reported speed.
    static_voltage : ndarray, shape (n,), [V]
        What Coulomb friction takes.
    """

    a0: Array
    a1: Array
    a2: Array
    delay: Array
    static_voltage: Array

    def __len__(self) -> int:
        """Return the number of motors."""
        return int(self.a0.size)


def motors_of(estimate: Estimate) -> Motors:
    """Return the motor of an estimate, from whatever combinations or parameters it holds.

    Parameters
    ----------
    estimate : Estimate
        With ``dc_gain`` and ``time_constant``, or with all physical parameters.

    Returns
    -------
    Motors
        A batch of one.

    Raises
    ------
    DesignError
        When the estimate holds neither, or one of them is not positive.
    """
    return _motors(estimate, {name: np.array([estimate.value(name)]) for name in _names(estimate)})


def draw_motors(estimate: Estimate, n: int, rng: np.random.Generator) -> Motors | None:
    """Draw motors from the distribution of the estimation error.

    Parameters
    ----------
    estimate : Estimate
        As for :func:`motors_of`.
    n : int
        Number of draws.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    Motors or None
        A batch of ``n``, or None where the estimate tells no uncertainty of its response.
    """
    names = _names(estimate)
    known = [name for name in names if name in estimate.names]
    if not known or not np.any(np.diag(estimate.covariance) > 0):
        return None
    draws = estimate.samples_of(names, n, rng)
    return _motors(estimate, dict(zip(names, draws.T, strict=True)))


def _names(estimate: Estimate) -> tuple[str, ...]:
    tail = ("static_voltage", "delay")
    if estimate.value("dc_gain") and estimate.value("time_constant"):
        return ("dc_gain", "time_constant", "time_constant_product", *tail)
    if all(estimate.value(n) for n in ("resistance", "motor_constant", "inertia")):
        return (*PHYSICAL, "coulomb_friction", "delay")
    raise DesignError(
        f"{estimate.wheel}: the estimate holds neither dc_gain and time_constant nor all physical "
        "parameters; identify the motor again"
    )


def _motors(estimate: Estimate, value: dict[str, Array]) -> Motors:
    if "dc_gain" in value:
        a0 = 1 / value["dc_gain"]
        a1 = value["time_constant"] * a0
        a2 = value["time_constant_product"] * a0
        static = value["static_voltage"]
    else:
        R, L, K, J, b = (value[name] for name in PHYSICAL)
        a0, a1, a2 = (R * b + K * K) / K, (R * J + L * b) / K, L * J / K
        static = R * value["coulomb_friction"] / K
    if not (np.all(a0 > 0) and np.all(a1 > 0) and np.all(a2 >= 0) and np.all(np.isfinite(a0))):
        raise DesignError(
            f"{estimate.wheel}: dc_gain and time_constant must be positive, they are "
            f"{1 / a0[0]:.4g} rad/s/V and {a1[0] / a0[0]:.4g} s"
        )
    return Motors(a0, a1, a2, np.maximum(value["delay"], 0.0), np.abs(static))


@dataclass(frozen=True, eq=False)
class Plant:
    r"""A batch of sampled motors with their delay and the way their speed is measured.

    ``x[k+1] = phi x[k] + sum_j taps[j] u[k-j]`` with ``x = (speed, scaled acceleration)``;
    the angle run through in the step is ``phi_angle x[k] + sum_j taps_angle[j] u[k-j]``.

    Attributes
    ----------
    phi : ndarray, shape (n, s, s)
        State transition over one sample; ``s`` is 1 for a first-order motor.
    taps : ndarray, shape (n, m, s)
        Effect of the last ``m`` controller outputs.
    phi_angle : ndarray, shape (n, s)
    taps_angle : ndarray, shape (n, m)
    sample_time : float
        [s].
    window : int
        Samples over which the measured speed is averaged; 0 measures it instantaneously.
    motors : Motors
        What was sampled.
    """

    phi: Array
    taps: Array
    phi_angle: Array
    taps_angle: Array
    sample_time: float
    window: int
    motors: Motors

    def __len__(self) -> int:
        """Return the number of motors."""
        return int(self.phi.shape[0])

    def repeated(self, n: int) -> Plant:
        """Return a batch of ``n`` copies of a batch of one, for ``n`` controllers.

        Parameters
        ----------
        n : int
            Number of copies.

        Returns
        -------
        Plant
            A batch of ``n``.
        """
        arrays = (self.phi, self.taps, self.phi_angle, self.taps_angle)
        phi, taps, phi_angle, taps_angle = (np.repeat(x, n, axis=0) for x in arrays)
        return Plant(phi, taps, phi_angle, taps_angle, self.sample_time, self.window, self.motors)

    def response(self, omega: Array, *, window: int | None = None) -> Complex:
        """Return the frequency response from controller output to measured speed.

        Parameters
        ----------
        omega : ndarray, shape (f,), [rad/s]
            Frequencies up to pi / sample_time.
        window : int or None
            Averaging window in samples; None takes the plant's own.

        Returns
        -------
        ndarray of complex, shape (n, f), [rad/s/V]
        """
        return self.transfer(np.exp(1j * np.asarray(omega) * self.sample_time), window=window)

    def transfer(self, z: Complex, *, window: int | None = None) -> Complex:
        """Return the transfer function at points of the z plane; see :meth:`response`.

        Parameters
        ----------
        z : ndarray of complex, shape (f,)
            Points other than poles.
        window : int or None
            Averaging window in samples; None takes the plant's own.

        Returns
        -------
        ndarray of complex, shape (n, f), [rad/s/V]
            One row per motor of the batch.
        """
        window = self.window if window is None else window
        z = np.asarray(z, dtype=np.complex128)
        delays = z[None, :] ** -np.arange(self.taps.shape[1])[:, None]
        drive = np.einsum("nms,mf->nsf", self.taps, delays)
        state = _resolvent(self.phi, z, drive)
        if window == 0:
            return state[:, 0]
        angle = np.einsum("ns,nsf->nf", self.phi_angle, state) + self.taps_angle @ delays
        sweep = np.sum(z[None, :] ** -(1.0 + np.arange(window))[:, None], axis=0)
        response: Complex = angle * sweep / (window * self.sample_time)
        return response


def sample(motors: Motors, loop: Loop, *, window: int | None = None) -> Plant:
    """Sample a batch of motors exactly, with the loop's and the motor's delay.

    Parameters
    ----------
    motors : Motors
        The batch.
    loop : Loop
        Sample time, delay, and how speed is measured.
    window : int or None
        Averaging window [samples]; None takes that of the loop.  An observer is taken as one
        sample: it has less lag and less noise than that.

    Returns
    -------
    Plant
        The sampled batch.
    """
    T = loop.sample_time
    if window is None:
        window = 1 if loop.speed_source == "observer" else int(loop.difference_window)
    total = loop.loop_delay + motors.delay
    whole = np.floor(total / T + 1e-9).astype(int)
    late = np.clip(total - whole * T, 0.0, T)
    A, B = _continuous(motors)
    n, s = B.shape
    phi, gamma, zeta = _integrals(A, B, np.full(n, T))
    _, recent, recent_angle = _integrals(A, B, T - late)
    taps = np.zeros((n, int(whole.max()) + 2, s))
    taps_angle = np.zeros(taps.shape[:2])
    row = np.arange(n)
    taps[row, whole] = recent
    taps[row, whole + 1] = gamma - recent
    taps_angle[row, whole] = recent_angle
    taps_angle[row, whole + 1] = zeta - recent_angle
    used = np.any(taps != 0, axis=(0, 2))
    m = int(np.flatnonzero(used)[-1]) + 1
    ones, _ = _mean_integral(A, np.full(n, T))
    return Plant(phi, taps[:, :m], ones[:, 0, :], taps_angle[:, :m], T, window, motors)


def _continuous(motors: Motors) -> tuple[Array, Array]:
    a0, a1, a2 = motors.a0, motors.a1, motors.a2
    if np.all(a2 <= 1e-12 * a1 * a1 / a0):
        return (-a0 / a1)[:, None, None], (1 / a1)[:, None]
    a2 = np.maximum(a2, 1e-10 * a1 * a1 / a0)
    natural = np.sqrt(a0 / a2)
    A = np.zeros((len(motors), 2, 2))
    A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = natural, -natural, -a1 / a2
    B = np.zeros((len(motors), 2))
    B[:, 1] = natural / a0
    return A, B


def _exponential(A: Array, t: Array) -> Array:
    """Return exp(A t) of a batch of 1x1 or 2x2 matrices in closed form."""
    if A.shape[1] == 1:
        first_order: Array = np.exp(A * t[:, None, None])
        return first_order
    half = 0.5 * np.trace(A, axis1=1, axis2=2)
    root = np.sqrt((half**2 - np.linalg.det(A)).astype(np.complex128))
    plus, minus = np.exp((half + root) * t), np.exp((half - root) * t)
    small = np.abs(root * t) < 1e-6
    safe = np.where(small, 1.0, root)
    sine = np.where(small, np.exp(half * t) * t, (plus - minus) / (2 * safe)).real
    cosine = (0.5 * (plus + minus)).real
    shifted = A - half[:, None, None] * np.eye(2)
    second_order: Array = cosine[:, None, None] * np.eye(2) + sine[:, None, None] * shifted
    return second_order


def _mean_integral(A: Array, t: Array) -> tuple[Array, Array]:
    """Return the first and second integrals of exp(A s) over 0 to t."""
    eye = np.eye(A.shape[1])
    first = np.linalg.solve(A, _exponential(A, t) - eye)
    second = np.linalg.solve(A, first - t[:, None, None] * eye)
    return first, second


def _integrals(A: Array, B: Array, t: Array) -> tuple[Array, Array, Array]:
    """Return transition, and what a constant input adds to state and angle, over ``t``."""
    first, second = _mean_integral(A, t)
    return (
        _exponential(A, t),
        np.einsum("nij,nj->ni", first, B),
        np.einsum("nij,nj->ni", second, B)[:, 0],
    )


def _resolvent(phi: Array, z: Complex, drive: Complex) -> Complex:
    """Return (z I - phi)^-1 drive for a batch of 1x1 or 2x2 matrices."""
    if phi.shape[1] == 1:
        solved: Complex = drive / (z - phi[:, :, 0])[:, None, :]
        return solved
    a, b = z - phi[:, 0, 0, None], -phi[:, 0, 1, None]
    c, d = -phi[:, 1, 0, None], z - phi[:, 1, 1, None]
    determinant = a * d - b * c
    return np.stack(
        [
            (d * drive[:, 0] - b * drive[:, 1]) / determinant,
            (a * drive[:, 1] - c * drive[:, 0]) / determinant,
        ],
        axis=1,
    )
