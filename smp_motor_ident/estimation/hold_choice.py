"""How the command ran between the samples: held, switched inside the interval, in its middle, or
straight from row to row."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from smp_motor_ident.diagnosis import limits
from smp_motor_ident.diagnosis.sample_limits import COMMAND_AHEAD
from smp_motor_ident.estimation import order_selection
from smp_motor_ident.estimation.candidate_starts import of_kind
from smp_motor_ident.estimation.consider_covariance import asks_for_earlier
from smp_motor_ident.estimation.current_lag import with_other_sensor
from smp_motor_ident.estimation.data_window import extend, grow
from smp_motor_ident.estimation.descent import ROUGHLY, refine, restate, screening_subset
from smp_motor_ident.estimation.fit import Fit, Options
from smp_motor_ident.estimation.initialisation import initial_fit
from smp_motor_ident.estimation.request import Request
from smp_motor_ident.estimation.selection import POLICY, FittedCandidate, sandwich_factor
from smp_motor_ident.estimation.thinning import thinned
from smp_motor_ident.estimation.trials import LAGS, tried
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments, prepare
from smp_motor_ident.likelihood.hold import between_samples
from smp_motor_ident.model.coordinates import Coordinates, direction
from smp_motor_ident.model.measurement import ANGLE
from smp_motor_ident.model.structures import SecondOrder, Structure
from smp_motor_ident.record import Record

ALIKE = 0.1
"""Samples by which the delays of two fits differ that may be the same."""
LOOKS = (1_000, 4_000, np.inf)
"""Samples on which it is asked whether another hold is worth a search: few, where it comes near
more, and all before the search."""
HOLDS = {
    "held": "held as recorded",
    "switched": "switched inside its intervals",
    "middle": "switched in the middle of its intervals",
}
EARLIER = {"before": -0.5, "after": 1.0, "interpolated": 0.5}
"""Samples of delay that a hold takes the place of: a command up to its row, with means that moved
its switches before; one from its row on; one straight from row to row."""


def chosen_hold(
    group: Sequence[Record], base: Structure, options: Options, say: Callable[[str], None]
) -> tuple[Experiments, str, Fit | None]:
    """Choose how the command ran inside the intervals, by what explains the outputs best."""
    plain = prepare(group, base.current)
    if base.order != 2 or "window" in base.fixed or plain.size > limits.HOLD_COST.value:
        return plain, "held", None
    if plain.kind != ANGLE or thinned(plain) is not plain:
        return plain, "held", None  # how the command ran within so short an interval is not shown
    others = {h: prepare(group, base.current, hold=h) for h in ("switched", "middle")}
    others = {h: d for h, d in others.items() if d.hold_end.size > plain.hold_end.size}
    if len(others) > 1 and others["switched"].held_like(others["middle"]):
        del others["middle"]
    if not others:
        return plain, "held", None
    say("how the command was held between samples")
    best = initial_fit(
        plain, base if base.current else SecondOrder.like(base, shape=False), options
    )
    chosen, hold = plain, "held"
    if best is None:
        return chosen, hold, None
    part = screening_subset(plain)
    near = refine(part, best.structure, best, best.z, options) if part is not plain else best
    for other, data in others.items():
        part = screening_subset(data)
        short = limits.HOLD_HOPELESS.value if part is not data else -limits.HOLD_EVIDENCE.value
        # From the torque noise that was found it shows soon whether this is worth a full search.
        soon = grow(part, best.structure, near, options, near)
        if soon.converged and soon.deviance > near.deviance + short:
            continue
        fitted = grow(part, best.structure, near, options)
        fitted = extend(data, best.structure, fitted, options)
        if fitted.deviance < best.deviance - limits.HOLD_EVIDENCE.value:
            chosen, hold, best = data, other, fitted
    return chosen, hold, best


def otherwise(
    group: list[Record],
    base: Structure,
    request: Request,
    data: Experiments,
    hold: str,
    candidates: list[FittedCandidate],
) -> tuple[Experiments, str, list[FittedCandidate]]:
    """Return data, hold and candidates, the choice last, with those under other holds."""
    for other, fit in _worth_a_search(group, data, hold, candidates[-1].fit, request.options):
        request.say("how the command ran between samples")
        again = data if other == hold else prepare(group, request.use_current, hold=other)
        again = again.measured_as(data.kind).held(fit.structure.held)
        there = base.with_(held=fit.structure.held, shift=fit.structure.shift)
        best = candidates[-1].fit
        far = POLICY.rejects_on_subset(fit, best.deviance)
        lost = far and _lost(again, there, request, data, best)
        rivals = [] if lost else _explored(again, there, request)
        whole = extend(of_kind(again, fit), fit.structure, fit, request.options)
        near = FittedCandidate(whole, f"as {candidates[-1].label}")
        first = not rivals or POLICY.likelier(near, rivals[-1])
        if first:  # another hold may have hidden how the current is filtered
            seen = of_kind(again, whole)
            sensed = with_other_sensor(seen, whole, request.options, rivals, request.say)
            near = replace(near, fit=sensed)
            rivals = [r for r in rivals if r.fit is not sensed]
        rivals = [*rivals, near] if first else [near, *rivals]
        better = POLICY.likelier(rivals[-1], candidates[-1])
        if other == hold:
            candidates = [*candidates, *rivals] if better else [*rivals, *candidates]
            continue
        # Nobody knows the odds of two holds: the numbers cover both where they explain alike.
        rest = (data, hold, candidates[-1]) if better else (again, other, rivals[-1])
        if better:
            data, hold, candidates = again, other, rivals
        beside = replace(rest[2], on=rest[0], hold=HOLDS[rest[1]])
        candidates = [*(r for r in candidates[:-1] if r.hold != beside.hold), candidates[-1]]
        candidates = [beside, *candidates]
    return data, hold, candidates


def earlier_command(
    group: Sequence[Record], request: Request, data: Experiments, hold: str, best: Fit
) -> tuple[list[Record], Request, Finding] | None:
    """Return records whose commands ran an interval earlier, where the motor answers that early.

    Rows that have the command which held up to them are read so by mistake where no edge shows it.
    """
    if request.within or request.earlier or not asks_for_earlier(of_kind(data, best), best):
        return None
    records = [_an_interval_earlier(r) for r in group]
    structure = best.structure.with_(held="before", delay=True)  # which would take it back
    there = prepare(records, structure.current, hold=hold).measured_as(best.kind)
    later = best.z.ln_a1 + float(np.log1p(data.step / best.z.time_constant))  # by as much a lag is
    found = initial_fit(there, structure, request.options, [best.z, best.z.with_(ln_a1=later)])
    if not found or found.deviance > best.deviance - POLICY.price(2, best.samples):
        return None
    # What leaves most of an error that is coloured is a part of another effect's.
    left = float(np.exp((found.deviance - best.deviance) / best.samples))
    coloured = sandwich_factor(found) > limits.COLOURED.value
    taken_back = found.z.delay > COMMAND_AHEAD.value * data.step
    of_current = found.noise[0, 0] > best.noise[0, 0]  # whose rounding, or lag, is no motion's
    if taken_back or of_current or (coloured and left > limits.HALF_EXPLAINED.value):
        return None
    known = request.validation
    kept = None if known is None else [_an_interval_earlier(r) for r in known]
    said = Finding(
        "held_before",
        "note",
        "the motion is ahead of the command as it was read: each row has the command that held up "
        "to it, and was taken so",
        {"shift": -data.step},
        "map held=before; else compare the clocks of command and motion",
    )
    return records, replace(request, earlier=True, validation=kept), said


def _an_interval_earlier(record: Record) -> Record:
    """Return a record with each row's command in the row before; a segment's last stays."""
    voltage = np.roll(record.voltage, -1)
    last = np.array([*record.starts[1:], len(record)]) - 1
    voltage[last] = record.voltage[last]
    return replace(record, voltage=voltage)


def _explored(data: Experiments, base: Structure, request: Request) -> list[FittedCandidate]:
    return order_selection.explore(
        data, base, request.options, request.model == "auto", request.say
    )


def _lost(
    again: Experiments, base: Structure, request: Request, data: Experiments, best: Fit
) -> bool:
    """Tell whether a part of a long record rejects by far all that a search under a hold finds."""
    duration = LOOKS[1] * data.step
    part, own = again.data_window(duration), of_kind(data.data_window(duration), best)
    if data.size <= 3 * part.size or part.size != own.size:
        return False
    known = refine(own, best.structure, best, best.z, request.options, ROUGHLY)
    rivals = _explored(part, base, request)
    return all(POLICY.rejects_on_subset(r.fit, known.deviance) for r in rivals) and bool(rivals)


def _worth_a_search(
    group: Sequence[Record], data: Experiments, hold: str, best: Fit, options: Options
) -> list[tuple[str, Fit]]:
    """Return how else the command may have run: the hold, and a fit of a `Structure.held` under it.

    A delay and a second lag take the place of a hold that is not the command's, and hide it
    from a comparison without them.
    """
    s = best.structure
    if best.samples > limits.HOLD_COST.value or "delay" in s.fixed or not np.ptp(data.hold_value):
        return []
    looks: dict[float, Fit] = {}
    for duration in (samples * data.step for samples in LOOKS):
        part = of_kind(data, best).data_window(duration)
        whole = part.size == best.samples
        looks[duration] = best if whole else refine(part, s, best, best.z, options, ROUGHLY)
        if whole:
            break
    late = best.z.delay / data.step
    out = []
    others = [("held", "before")] * (hold != "held") + [(hold, "after"), (hold, "interpolated")]
    for other, how in others:
        there = data if other == hold else prepare(group, s.current, hold=other)
        there, lag = of_kind(there, best), late - EARLIER[how]
        fits: list[Fit] = []
        for duration, least in looks.items():
            part = there.data_window(duration).held(how)
            fits = _delayed(part, least, how, lag, options, fits)
            found = fits[0]
            # What has not settled, or saw little of the data, tells against a search only where
            # its residuals are of another size.
            near = part.size * (1.0 + (part.current.size > 0))
            if (duration > min(looks) or len(looks) == 1) and found.converged:
                near = POLICY.price(1, part.size)
            if found.deviance >= least.deviance + near:
                break
        else:
            out.append((other, found))
    return out


def _delayed(
    part: Experiments, best: Fit, how: str, lag: float, options: Options, before: list[Fit]
) -> list[Fit]:
    """Return fits from the choice's coordinates, as late as that many samples; the likeliest first.

    Earlier than no delay only a shorter second lag is.  What a shorter look found is gone on from;
    of fits of the same delay the likeliest stays.
    """
    apart = how == "before"  # under another hold; the others differ by their instants alone
    starts = {max(lag, 0.0): best.z, float(max(round(lag), 0)): best.z}
    if best.structure.order == 2:
        te = best.z.second_lag
        if apart:  # for a delay beside the other hold it may stand
            starts[(best.z.delay + 0.5 * te) / part.step] = _shorter(best.z, 0.5)
        if lag < 0:
            starts[-1.0] = _shorter(best.z, max(1 + lag * part.step / te, 0.1))
    if before:
        starts = {f.z.delay / part.step: f.z for f in before}
    near = [best] if best.noise_ratio == 0 else [best, replace(best, noise_ratio=0.0)]
    begun: list[tuple[Fit, Structure]] = []
    for samples, start in starts.items():
        delay = max(samples, 0.0) * part.step
        shift = part.step if how == "after" else 0.0
        structure = best.structure.with_(held=how, delay=delay > 0, shift=shift)
        z = start.with_(delay=delay)
        fixed = structure.with_(delay=False, fixed={**structure.fixed, "delay": delay})
        whole = [refine(part, fixed, n, fixed.complete(z), options, ROUGHLY) for n in near]
        begun.append((min(whole, key=lambda f: f.deviance), structure))
    begun.sort(key=lambda fit: fit[0].deviance)
    found = [_freed(part, *fit, options) for fit in (begun if apart else begun[:1])]
    found.sort(key=lambda f: f.deviance)
    return [
        fit
        for n, fit in enumerate(found)
        if all(abs(fit.z.delay - f.z.delay) > ALIKE * part.step for f in found[:n])
    ]


def _freed(part: Experiments, fit: Fit, structure: Structure, options: Options) -> Fit:
    """Return a fit at a fixed delay with that set free: a hold may be a part of a sample late."""
    fit = restate(part, structure, fit, options)
    if not structure.delay:
        return fit
    freed = refine(part, structure, fit, fit.z, options, ROUGHLY)
    return tried(part, min(fit, freed, key=lambda f: f.deviance), LAGS, options)


def _shorter(z: Coordinates, share: float) -> Coordinates:
    """Return the coordinates of a motor with a share of its second lag."""
    return z.moved(direction(ln_a2=1.0, ln_te=1.0) * np.log(share))


def instant_deviation(group: Sequence[Record], hold: str) -> float:
    """Return how well the input's instants are known [s].

    A command on a clock of its own, or jittered stamps, leave a part of an interval open; how
    the stamps scatter, of the mean over all changes of the command.
    """
    most = int(limits.HOLD_COST.value)
    steps = np.concatenate([np.diff(r.time[:most]) for r in group])
    squares = np.concatenate([np.square(np.diff(r.voltage[:most])) for r in group])
    step = float(np.median(steps))
    jitter = float(np.median(np.abs(steps - step)))
    loose = hold != "held" or jitter > 1e-3 * step or any(between_samples(r) for r in group)
    near = steps[steps < 2.5 * step]  # no gaps
    changes = max(float(squares.sum()) / max(float(squares.max(initial=0.0)), 1e-300), 1.0)
    scatter = float(near.std()) / np.sqrt(2 * changes)  # each stamp is in two intervals
    return max(limits.INSTANT.value * step, scatter) if loose else 0.0
