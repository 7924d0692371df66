"""Estimates that are refused after the fit: the model does not explain the data, or too little."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from smp_motor_ident.diagnosis.data_quality import where_of
from smp_motor_ident.diagnosis.limits import LARGEST_OFFSET, LOOSE_QUANTITY, WORST_FIT
from smp_motor_ident.diagnosis.validation import speed_fit, stands, within_resolution
from smp_motor_ident.errors import (
    CurrentError,
    InsufficientExcitationError,
    SignalError,
    SmpError,
    UnknownLagError,
)
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.prediction import simulate
from smp_motor_ident.estimation.quantities import Answer
from smp_motor_ident.estimation.selection import FittedCandidate
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.record import Record


def no_candidate(group: Sequence[Record]) -> InsufficientExcitationError:
    """Return the refusal of data that no structure could be started on."""
    return InsufficientExcitationError(
        f"{where_of(group)}: no motor model explains these data; record 20 s or more of a "
        "square or Fourier voltage that turns the motor in both directions"
    )


def of_which(
    group: Sequence[Record], refusal: SmpError, alone: Callable[[Record], object]
) -> SmpError:
    """Return the refusal of several records, with those by name of which ``alone`` is refused."""
    if len(group) < 2 or not str(refusal).startswith(where_of(group)):
        return refusal
    refused: dict[str, str] = {}
    names = [r.source or f"record {n + 1}" for n, r in enumerate(group)]
    for name, record in zip(names, group, strict=True):
        try:
            alone(record)
        except (SignalError, InsufficientExcitationError) as own:
            refused[name] = str(own)
    if len(refused) == len(group):
        return refusal
    if not refused:
        words = "each of them alone is explained: they are not of one motor, wiring and scale"
    else:
        words = "the others are explained without " + " and ".join(refused)
        words += f"; alone: {next(iter(refused.values()))}"
    return type(refusal)(f"{refusal}; {words}")


def explains(
    group: Sequence[Record], data: Experiments, candidates: Sequence[FittedCandidate]
) -> bool:
    """Tell whether the last of the candidates explains the motion."""
    fit = candidates[-1].fit
    return _enough(speed_fit(group, of_kind(data, fit), fit))


def refuse_unexplained(group: Sequence[Record], data: Experiments, fit: Fit, fitted: float) -> None:
    """Refuse what the model does not explain."""
    explained = _enough(fitted)
    if not explained and stands(data, fit):
        raise InsufficientExcitationError(
            f"{where_of(group)}: the motor stands: what its angle moves is the sensor's scatter, "
            f"while the voltage reaches {np.abs(data.hold_value).max():.3g} V; drive harder"
        )
    if not explained and not within_resolution(data, fit) and not _follows(group, data, fit):
        raise SignalError(
            f"{where_of(group)}: the voltage does not explain the motion (fit {fitted:.0f} %); "
            "check that voltage and encoder belong to the same motor, that the driver puts out "
            "what is commanded (no clip at the supply, no coasting), that no rows were left out "
            "between, and that nothing else drives it"
        )
    _refuse_offset(group, fit)


def refuse_unidentifiable(group: Sequence[Record], fit: Fit, result: Answer) -> None:
    """Refuse what the data hardly tell."""
    loose = [
        n
        for n in ("dc_gain", "time_constant")
        if (q := result.combinations.get(n))
        and (q.std or 0) > LOOSE_QUANTITY.value * abs(q.value or 1)
    ]
    if loose:
        _refuse_integral(group, fit)
        refusal = UnknownLagError if loose == ["time_constant"] else InsufficientExcitationError
        raise refusal(
            f"{where_of(group)}: the data do not tell {' and '.join(loose)}; record a longer "
            "excitation with several frequencies, in both directions and well above the friction"
        )


def fallen_back(refusal: SmpError | None, other: str) -> list[Finding]:
    """Say that an answer is another candidate's than the one that fits the samples best."""
    if refusal is None:
        return []
    return [
        Finding(
            "choice_refused",
            "unreliable",
            f"the structure that fits the samples best was refused ({refusal}); this is "
            f"the answer of {other}",
            advice="record longer, with sharper and larger steps",
        )
    ]


def lag_unknown(result: Answer, refusal: UnknownLagError | None, step: float) -> Iterator[Finding]:
    """Say that an answer leaves open how slow the motor is, at this sampling interval [s]."""
    if refusal is None:
        return
    low, high = result.combinations["time_constant"].ci95 or (0.0, np.inf)
    quick = high < step
    cause = "a load that fluctuates, or what the model lacks, takes its place"
    advice = "record longer, with several frequencies, in both directions and well above friction"
    yield Finding(
        "lag_unknown",
        "warning" if quick else "unreliable",
        f"the data do not tell time_constant: it may be anything from {low:.3g} to {high:.3g} "
        f"s; {f'it is over within the {step:.3g} s between samples' if quick else cause}",
        {"low": float(low), "high": float(high), "sample_time": step},
        "sample faster" if quick else advice,
    )


def _enough(fitted: float) -> bool:
    return bool(np.isfinite(fitted)) and fitted >= WORST_FIT.value


def _follows(group: Sequence[Record], data: Experiments, fit: Fit) -> bool:
    """Tell whether the free run is near a speed that hardly changes, beside its size.

    Of a motor at one speed the scatter is the counter's: no share of it says anything.
    """
    speed = simulate(data, fit)[:, 0]
    size = float(np.sqrt(np.mean(np.square(speed))))
    return size > 0 and speed_fit(group, data, fit, size) >= WORST_FIT.value


def _refuse_integral(group: Sequence[Record], fit: Fit) -> None:
    """Name a speed that never becomes steady: an angle, or a record that ends too soon."""
    longest = max(r.duration for r in group)
    if fit.z.time_constant < longest or any(r.velocity is None for r in group):
        return
    raise SignalError(
        f"{where_of(group)}: velocity changes for as long as there is a voltage and is never "
        f"steady within {longest:.3g} s, as an angle does; if it is an angle, map it as position, "
        "else record until the speed is steady"
    )


def _refuse_offset(group: Sequence[Record], fit: Fit) -> None:
    offset = abs(fit.z.current_offset)
    if offset == 0.0:
        return
    largest = max(float(np.nanmax(np.abs(r.current))) for r in group if r.current is not None)
    if offset > LARGEST_OFFSET.value * max(largest - offset, 1e-12):
        raise CurrentError(
            f"{where_of(group)}: current has an offset of {fit.z.current_offset:.3g} A where it "
            f"reaches {largest:.3g} A; zero the current sensor at rest and record again"
        )


def only_lag_unknown(group: Sequence[Record], fit: Fit, result: Answer) -> UnknownLagError | None:
    """Refuse what cannot be stated; return the refusal of which the lag alone is the reason."""
    try:
        refuse_unidentifiable(group, fit, result)
    except UnknownLagError as refusal:
        return refusal
    return None
