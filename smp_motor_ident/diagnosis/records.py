"""Several records of one motor, estimated one by one: whether they are of one motor.

Random effects: record i says ``x_i = mu + u_i + e_i`` with ``var e_i`` its stated variance and
``var u_i`` the scatter between records, estimated by the method of moments.

References
----------
R. DerSimonian, N. Laird, Meta-analysis in clinical trials, Controlled Clinical Trials 7 (1986);
W. G. Cochran, The combination of estimates from different experiments, Biometrics 10 (1954).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from smp_motor_ident.diagnosis.limits import SAME_MOTOR
from smp_motor_ident.finding import Finding
from smp_motor_ident.result import Estimate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RecordScatter:
    """One quantity over several records of one motor."""

    name: str  # quantity
    # mean, std: over the records, with the scatter between them as part of its uncertainty
    mean: float
    std: float
    between: float  # standard deviation of the quantity from record to record
    p_value: float  # of so much scatter from the records' own uncertainties alone
    farthest: int  # index of the record that lies farthest from the others, in its own deviations


def between_records(estimates: Sequence[Estimate]) -> list[RecordScatter]:
    """Return how far records of one motor scatter beyond their stated uncertainties."""
    names = dict.fromkeys(n for e in estimates for n in (*e.combinations, *e.parameters))
    out = []
    for name in names:
        stated = [
            (k, q.value, q.std)
            for k, e in enumerate(estimates)
            if (q := e.combinations.get(name) or e.parameters.get(name)) is not None
            and q.value is not None
            and q.std
        ]
        if len(stated) > 1:
            index, values, deviations = zip(*stated, strict=True)
            out.append(_scatter(name, index, np.array(values), np.array(deviations)))
    return out


def _scatter(name: str, index: Sequence[int], values: Array, deviations: Array) -> RecordScatter:
    weight = 1 / deviations**2
    common = float(weight @ values / weight.sum())
    q = float(weight @ np.square(values - common))
    freedom = len(values) - 1
    spare = weight.sum() - np.square(weight).sum() / weight.sum()
    between = max(0.0, (q - freedom) / float(spare))
    weight = 1 / (deviations**2 + between)
    mean = float(weight @ values / weight.sum())
    farthest = int(np.argmax(np.abs(values - mean) * np.sqrt(weight)))
    return RecordScatter(
        name,
        mean,
        float(weight.sum() ** -0.5),
        float(np.sqrt(between)),
        float(chdtrc(freedom, q)),
        index[farthest],
    )


def same_motor(estimates: Sequence[Estimate]) -> list[Finding]:
    """Say whether several records are of one motor, by what they state."""
    scatters = between_records(estimates)
    out = []
    for s in scatters:
        if s.p_value >= SAME_MOTOR.value / len(scatters):
            continue
        sources = ", ".join(estimates[s.farthest].sources) or f"record {s.farthest + 1}"
        out.append(
            Finding(
                "records_differ",
                "warning",
                f"{s.name} differs between the records by {s.between:.3g} beyond what each "
                f"states ({s.mean:.5g} +- {s.std:.2g} over all); {sources} lies farthest",
                {"quantity": s.name, "between": s.between, "p_value": s.p_value},
                "take the value over all records with its larger deviation; if one record differs, "
                "look what changed (load, temperature, supply, motor)",
            )
        )
    if scatters and not out:
        lowest = min(s.p_value for s in scatters)
        message = f"the {len(estimates)} records agree within what each states"
        out.append(Finding("records_agree", "note", message, {"p_value": lowest}))
    return out
