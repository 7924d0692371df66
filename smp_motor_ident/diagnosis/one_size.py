"""What a voltage of one size, or steps of one, cannot show."""

import math
from collections.abc import Iterator

import numpy as np

from smp_motor_ident.diagnosis.limits import REST, SAME_LEVEL
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.coordinates import direction

FEWEST_SWINGS = 6  # of which it can be said that they are alike
OFTEN = 0.2  # of the rows: a command that changes in more of them makes no steps


def one_size(data: Experiments, fit: Fit, accuracy: float) -> Iterator[Finding]:
    """Yield what is to be said of a voltage, or of steps, of one size."""
    said = one_size_of_voltage(one_size_or_swing(data), accuracy)
    yield from said or _one_size_of_step(_one_step(data))
    share = _weaker_side(data, fit)
    if share > 0:
        yield Finding(
            "asymmetry",
            "note",
            f"under one size of voltage a load that takes {abs(fit.z.load):.3g} V is also a driver "
            f"or motor that is weaker one way by {200 * share:.2g} %: the intervals cover both",
            {"load_voltage": fit.z.load, "share": share},
            "add levels of other sizes, which tell the two apart",
        )


def consider_weaker_side(data: Experiments, fit: Fit) -> Fit:
    """Return the fit with its covariance widened by what one side of a driver puts out less.

    Under a voltage of one size U a side that puts out ``(1 - 2 s) U`` is a load of ``s U`` beside
    a motor of as much less gain, in whose volts all is: nothing tells which of the two it is.
    """
    share = _weaker_side(data, fit)
    if not share:
        return fit
    volts = {n: fit.z.value(n) for n in ("vc_plus", "vc_minus", "load")}
    row = direction(ln_a0=1.0, ln_a1=1.0, ln_a2=1.0, ln_r=1.0, **volts)
    # Of none of it and all of it, each as likely, the root mean square.
    return fit.along(share / math.sqrt(2.0) * fit.structure.of_free(row))


def _weaker_side(data: Experiments, fit: Fit) -> float:
    """Return the load's share of a voltage of one size both ways, 0 where there is neither.

    A load that draws a current is one; what a side puts out less is an offset of the current, too.
    """
    free = fit.structure.free
    if data.one_way or "load" not in free or not (top := size_of_voltage(data)):
        return 0.0
    volts = abs(fit.z.load)
    if fit.structure.current:
        offset = fit.z.current_offset if "current_offset" in free else 0.0
        volts = min(volts, math.exp(fit.z.ln_r) * abs(offset))
    return volts / top


def one_size_or_swing(data: Experiments) -> float:
    """Return the voltage's only size, or that of its only swing; 0 where there are more."""
    return size_of_voltage(data) or _one_swing(data)


def size_of_voltage(data: Experiments) -> float:
    """Return the size of a voltage that is only switched between one size both ways, else 0.

    A single row between two levels is no third: the voltage is the mean over a row in which it
    was switched, or was interpolated over rows that were lost there.
    """
    levels = data.levels
    top = float(np.abs(levels).max())
    other = (top - np.abs(levels) > SAME_LEVEL.value * top) & (np.abs(levels) > REST.value * top)
    change = np.diff(levels)
    between = (change[:-1] * change[1:] > 0) & ~other[:-2] & ~other[2:]
    other[1:-1] &= ~between
    return 0.0 if other.any() else top


def _one_swing(data: Experiments) -> float:
    """Return the peak of a voltage that swings there and back always as far and as long, else 0.

    A sine of one amplitude and frequency, above all; what begins and ends it does not count.
    """
    value = data.hold_value
    turns = np.flatnonzero(np.diff(value >= 0)) + 1
    if turns.size < FEWEST_SWINGS:
        return 0.0
    peaks = np.maximum.reduceat(np.abs(value), turns)[:-1]
    lengths = np.diff(data.hold_end[turns - 1])
    peak, length = float(np.median(peaks)), float(np.median(lengths))
    alike = (np.abs(peaks - peak) < SAME_LEVEL.value * peak) & (
        np.abs(lengths - length) < SAME_LEVEL.value * length + 1.5 * data.step
    )
    return peak if float(alike.mean()) > 1 - SAME_LEVEL.value else 0.0


def _one_step(data: Experiments) -> float:
    """Return the size of a voltage's steps where they have only one, else 0."""
    change = np.abs(np.diff(data.levels))
    steps = change[change > REST.value * float(np.abs(data.levels).max())]
    if not FEWEST_SWINGS <= steps.size < OFTEN * change.size:
        return 0.0
    size = float(np.median(steps))
    alike = np.abs(steps - size) < SAME_LEVEL.value * size
    return size if float(alike.mean()) > 1 - SAME_LEVEL.value else 0.0


def _one_size_of_step(size: float) -> list[Finding]:
    """Say what steps of one size cannot show: a ramp that is as long at each is a lag."""
    if not size:
        return []
    return [
        Finding(
            "one_size_of_step",
            "warning",
            f"every step of the voltage has one size, {size:.3g} V: a driver that lets it rise "
            "slowly is as late at each of them, and looks like a delay, a lag or a filter",
            {"voltage": size},
            "record the voltage at the motor's terminals, or add steps of other sizes",
        )
    ]


def one_size_of_voltage(top: float, accuracy: float) -> list[Finding]:
    """Say what a voltage of one size both ways, or of one swing, cannot show.

    ``accuracy``: how well gain and lag are known at other voltages, relative.

    With a size U a driver that takes a share of it (a dead zone, a drop, a clip, pulses) is the
    motor of another gain under U: no residual tells the two apart, and next to none a drag by
    the square of a speed that is of one size, too.  Under a sine it is another
    gain of the fundamental (its describing function), and the motor hides the harmonics.
    """
    if not top:
        return []
    return [
        Finding(
            "one_size_of_voltage",
            "warning",
            f"the voltage has one size, {top:.3g} V: a driver that puts out less of it (a dead "
            "zone, a drop, a clip at the supply, coasting between its pulses) or lets it rise "
            "slowly, and a drag by the square of the speed, look like a motor of another gain or "
            f"lag, each of which is taken as known to {accuracy:.2g}",
            {"voltage": top},
            "add levels of other sizes, or record the voltage at the motor's terminals and state "
            "its accuracy (`voltage_accuracy`)",
        )
    ]
