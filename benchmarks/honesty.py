# SPDX-License-Identifier: Apache-2.0
"""Compare stated identifiability with theory, case by case.

Theory is the rank of the sensitivities, and at full rank the Cramer-Rao bound: a parameter whose
bound is above half of its value does not count as separable.

Usage: python benchmarks/honesty.py [--seconds 12] [--records N]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import islice

import numpy as np
from efficiency import covariance
from known_motors import TABLE_1, recording, table

from smp_motor_control.motor.parameters import PHYSICAL, MotorParameters
from smp_motor_ident.errors import SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Record

LOOSE = 0.5  # relative standard deviation above which a value is not stated
CASES = (
    (True, ()),
    (True, ("resistance",)),
    (False, ()),
    (False, ("resistance",)),
    (False, ("resistance", "inductance")),
    (False, ("resistance", "viscous_friction")),
)


def separable(parameters: dict[str, float], current: bool, fixed: tuple[str, ...]) -> bool:
    """Return whether the signals of a linear motor separate all that is not fixed, by their rank.

    ``w/v`` shows ``a0, a1, a2``; with current ``i/v = (J s + b)/(K ...)`` shows all five.
    """
    names = [n for n in PHYSICAL[:5] if n not in fixed]
    s = 2j * np.pi * np.geomspace(0.05, 50, 40)

    def response(x: np.ndarray) -> np.ndarray:
        values = {**parameters, **dict(zip(names, np.exp(x)))}
        r, el, k, j, b = (values[n] for n in PHYSICAL[:5])
        below = (el * s + r) * (j * s + b) + k * k
        parts = [np.log(k / below)] + [np.log((j * s + b) / below)] * current
        both = np.concatenate(parts)
        return np.concatenate([both.real, np.unwrap(both.imag)])

    base = np.log([parameters[n] for n in names])
    rows = [response(base + step) - response(base - step) for step in 1e-5 * np.eye(len(names))]
    values = np.linalg.svd(np.array(rows), compute_uv=False)
    return bool(values[-1] > 1e-7 * values[0])


def theory(
    record: Record, motor: MotorParameters, current: bool, known: tuple[str, ...]
) -> tuple[bool, str]:
    """Return whether theory separates all parameters from these data, and why."""
    if not separable({n: getattr(motor, n) for n in PHYSICAL[:5]}, current, known):
        return False, "rank"
    if known == ("resistance", "viscous_friction"):
        return False, "two roots"  # K^2 - a0 K + R b = 0
    rubs = PHYSICAL if motor.coulomb_friction else PHYSICAL[:5]
    free = tuple(n for n in rubs if n not in known)
    std = np.sqrt(np.diag(covariance(record, motor, free)))
    least = max(x for n, x in zip(free, std) if n in PHYSICAL[:5])
    return least < LOOSE, f"bound {least:.2g}"


def run(seconds: float = 12.0, records: int | None = None) -> Iterator[dict]:
    """Yield the results of theory and tool for every case."""
    return islice(_cases(seconds), records)


def _cases(seconds: float) -> Iterator[dict]:
    for wheel, p in TABLE_1.items():
        truth = dict(zip(PHYSICAL, p))
        for volts in (0.0, 0.4):
            for current, known in CASES:
                record, motor = recording(
                    p, "all", current=current, static_voltage=volts, seconds=seconds
                )
                can, why = theory(record, motor, current, known)
                try:
                    e = estimate(record, fixed={n: truth[n] for n in known})
                    says = [n for n in e.unidentifiable if n != "coulomb_friction"]
                    close = all(
                        abs(q.value - truth[n]) < 4 * q.std
                        for n, q in e.parameters.items()
                        if n in truth and q.status == "estimated"
                    )
                    fine = (not says) == can and close
                    verdict = "separates all" if not says else "cannot: " + ", ".join(says)
                except SmpError as refusal:
                    fine, verdict, close = False, str(refusal)[:60], True
                yield {
                    "motor": wheel, "friction": volts, "current": current, "fixed": known,
                    "theory": f"{'can' if can else 'cannot'} ({why})", "tool": verdict,
                    "close": close, "fine": fine,
                }  # fmt: skip


def main() -> None:
    """Run all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--records", type=int, help="only so many")
    args = parser.parse_args()
    rows = []
    for line in run(args.seconds, args.records):
        rows.append(
            (line["motor"], line["friction"], "yes" if line["current"] else "no",
             ", ".join(line["fixed"]) or "-", line["theory"], line["tool"],
             "yes" if line["close"] else "NO", "as theory" if line["fine"] else "OTHERWISE")
        )  # fmt: skip
        print(rows[-1], flush=True)
    head = ("motor", "friction [V]", "current", "fixed", "theory", "the tool", "within 4 std", "")
    print("\n" + table(head, rows))
    print(f"\n{sum(row[-1] == 'as theory' for row in rows)} of {len(rows)} as theory says")


if __name__ == "__main__":
    main()
