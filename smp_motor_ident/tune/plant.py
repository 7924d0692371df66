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

from smp_motor_control.motor.model import MotorModel
from smp_motor_control.observer import ObserverNoise
from smp_motor_ident.errors import DesignError
from smp_motor_ident.tune.arrays import Array, Complex
from smp_motor_ident.tune.loop import Loop
from smp_motor_ident.tune.motors import Motors
from smp_motor_ident.tune.seen import Seen, seen_by_observer

LONGEST = 300
"""Samples of delay and averaging that a loop may have."""


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
    seen : Seen or None
        The observer through which the speed is seen, where it is fed back; then ``window`` is 0.
    """

    phi: Array
    taps: Array
    phi_angle: Array
    taps_angle: Array
    sample_time: float
    window: int
    motors: Motors
    seen: Seen | None = None

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
        made = (phi, taps, phi_angle, taps_angle, self.sample_time, self.window, self.motors)
        return Plant(*made, self.seen)

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
        instantaneous = window == 0 or (self.window == 0 and self.seen is None)
        window = self.window if window is None else window
        z = np.asarray(z, dtype=np.complex128)
        delays = z[None, :] ** -np.arange(self.taps.shape[1])[:, None]
        drive = np.einsum("nms,mf->nsf", self.taps, delays)
        state = _resolvent(self.phi, z, drive)
        if instantaneous:
            return state[:, 0]
        angle = np.einsum("ns,nsf->nf", self.phi_angle, state) + self.taps_angle @ delays
        if self.seen is not None:
            from_angle, from_voltage = self.seen.transfer(z)
            told = self.seen.taps @ z[None, :] ** -np.arange(self.seen.taps.size)[:, None]
            seen: Complex = from_angle * angle + from_voltage * told
            return seen
        sweep = np.sum(z[None, :] ** -(1.0 + np.arange(window))[:, None], axis=0)
        response: Complex = angle * sweep / (window * self.sample_time)
        return response

    def angle_noise(self, omega: Array) -> Array:
        """Return how an error of the counted angle shows in the speed."""
        T = self.sample_time
        if self.seen is not None:
            z = np.exp(1j * np.asarray(omega) * T)
            squared: Array = np.abs(self.seen.transfer(z)[0] * (z - 1)) ** 2
            return squared
        if not self.window:
            return np.zeros(np.shape(omega))
        difference: Array = 2 * np.sin(0.5 * omega * self.window * T) / (self.window * T)
        return difference**2


def sample(
    motors: Motors, loop: Loop, *, window: int | None = None, believed: Motors | None = None
) -> Plant:
    """Sample a batch of motors exactly, with the loop's and the motor's delay.

    Parameters
    ----------
    motors : Motors
        The batch.
    loop : Loop
        Sample time, delay, and how speed is measured.
    window : int or None
        Averaging window [samples]; None takes that of the loop.
    believed : Motors or None
        The motor that an observer in the loop takes them all for; None takes the first of them.

    Returns
    -------
    Plant
        The sampled batch.

    Raises
    ------
    DesignError
        When delay and window are more samples than a loop can be designed for.
    """
    T = loop.sample_time
    seen = None
    if window is None:
        window = int(loop.difference_window)
        if loop.speed_source == "observer" and loop.count_angle:
            window, seen = 0, _seen(motors if believed is None else believed, loop)
    total = loop.loop_delay + motors.delay
    whole = np.floor(total / T + 1e-9).astype(int)
    late = np.clip(total - whole * T, 0.0, T)
    if int(whole.max()) + window > LONGEST:
        raise DesignError(
            f"a delay of {1e3 * float(total.max()):.4g} ms and a window of {window} samples at "
            f"{loop.rate:.4g} Hz are {int(whole.max()) + window} samples, of which at most "
            f"{LONGEST} can be designed for; sample at {LONGEST / max(float(total.max()), T):.3g} "
            "Hz or less, or average over fewer samples"
        )
    A, B = _continuous(motors)
    n, s = B.shape
    phi, gamma, zeta = _integrals(A, B, np.full(n, T))
    _, recent, recent_angle = _integrals(A, B, T - late)
    longest = max(int(whole.max()) + 2, 0 if seen is None else seen.taps.size)
    taps = np.zeros((n, longest, s))
    taps_angle = np.zeros(taps.shape[:2])
    row = np.arange(n)
    taps[row, whole] = recent
    taps[row, whole + 1] = gamma - recent
    taps_angle[row, whole] = recent_angle
    taps_angle[row, whole + 1] = zeta - recent_angle
    used = np.any(taps != 0, axis=(0, 2))
    m = int(np.flatnonzero(used)[-1]) + 1
    if seen is not None:
        m = max(m, seen.taps.size)
    ones, _ = _mean_integral(A, np.full(n, T))
    return Plant(phi, taps[:, :m], ones[:, 0, :], taps_angle[:, :m], T, window, motors, seen)


def _seen(believed: Motors, loop: Loop) -> Seen:
    """Return the observer that runs with the first of some motors as its model."""
    a0, a1, a2 = (float(a[0]) for a in (believed.a0, believed.a1, believed.a2))
    model = MotorModel(
        dc_gain=1 / a0,
        time_constant=a1 / a0,
        time_constant_product=a2 / a0,
        delay=float(believed.delay[0]),
    )
    return seen_by_observer(
        model, loop.sample_time, loop.count_angle, ObserverNoise(), loop.loop_delay
    )


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
