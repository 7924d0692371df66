"""Every case where theory says that a parameter cannot be separated, and where it can.

Usage: python benchmarks/honesty.py
"""

from __future__ import annotations

from known_motors import TABLE_1, recording, table

from smp_motor_ident.errors import SmpError
from smp_motor_ident.estimate import estimate
from smp_motor_ident.models import PHYSICAL


def main() -> None:
    """Run all cases and print the table."""
    rows = []
    wrong = 0
    for wheel, p in TABLE_1.items():
        truth = dict(zip(PHYSICAL, p))
        for volts in (0.0, 0.4):
            for current, known in (
                (True, ()),
                (True, ("resistance",)),
                (False, ()),
                (False, ("resistance",)),
                (False, ("resistance", "inductance")),
                (False, ("resistance", "viscous_friction")),
            ):
                record, _ = recording(p, "all", current=current, static_voltage=volts, seconds=12.0)
                fixed = {n: truth[n] for n in known}
                # With R and b known K, and J against L, solve quadratics: two motors each.
                can = current or known == ("resistance", "inductance")
                try:
                    e = estimate(record, fixed=fixed)
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
                wrong += not fine
                rows.append(
                    (wheel, volts, "yes" if current else "no", ", ".join(known) or "-",
                     "can" if can else "cannot", verdict, "yes" if close else "NO",
                     "as theory" if fine else "OTHERWISE")
                )  # fmt: skip
                print(rows[-1], flush=True)
    head = ("motor", "friction [V]", "current", "fixed", "theory", "the tool", "within 4 std", "")
    print("\n" + table(head, rows))
    print(f"\n{len(rows) - wrong} of {len(rows)} as theory says")


if __name__ == "__main__":
    main()
