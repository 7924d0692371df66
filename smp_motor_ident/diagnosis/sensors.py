"""What a fit says of command and sensors: when they are, offset and misfit, how they average."""

from collections.abc import Iterator

import numpy as np

from smp_motor_ident.diagnosis.limits import FIT_EXPLAINS, INSTANT, LONG_DELAY, SHARP
from smp_motor_ident.diagnosis.residuals import coloured
from smp_motor_ident.estimation import prediction
from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.estimation.lag_exchange import exchanged
from smp_motor_ident.finding import Finding
from smp_motor_ident.likelihood.experiments import Experiments
from smp_motor_ident.model.structures import Electromechanical
from smp_motor_ident.result import NORMAL_95


def sensors(data: Experiments, fit: Fit) -> Iterator[Finding]:
    """Yield what was found of the sensors."""
    yield from _fit_of_current(data, fit)
    s = fit.structure
    if isinstance(s, Electromechanical) and s.offset:
        offset = fit.z.current_offset
        yield Finding(
            "current_offset",
            "warning",
            f"current has an offset of {1e3 * offset:.3g} mA, removed",
            {"offset": offset},
            "zero the current sensor at rest",
        )
    if isinstance(s, Electromechanical) and s.lags:
        yield _current_lag(s.current_sensor, fit.z.current_lag)
    if s.has("window") and fit.z.window > INSTANT.value * data.step:
        yield _late_speed(0.5 * fit.z.window) if s.late else _filtered_speed(fit)
    if s.shift > 0:
        yield _late_command(s.shift)
    yield from _long_delay(data, fit)


def _long_delay(data: Experiments, fit: Fit) -> Iterator[Finding]:
    """Question a delay far beyond the motor's lag, which friction makes of a slow command."""
    delay, lag = fit.z.delay, fit.z.time_constant
    if delay <= LONG_DELAY.value * lag or "delay" not in fit.structure.free:
        return
    change = np.abs(np.diff(data.hold_value))
    seen = data.hold_end[:-1] + delay + lag < data.time[-1]
    sharp = bool(np.any(change[seen] > SHARP.value * np.ptp(data.hold_value)))
    yield Finding(
        "long_delay",
        "warning" if sharp else "unreliable",
        f"the delay of {delay:.3g} s is {delay / lag:.2g} times the time constant"
        + ("" if sharp else ": a slow command that overcomes static friction late looks so"),
        {"delay": delay, "time_constant": lag},
        "" if sharp else "record steps: what is late after a step is delay",
    )


def _late_command(shift: float) -> Finding:
    """Say that a row's command ran an interval later than its row has it."""
    return Finding(
        "late_command",
        "note",
        f"the command acts an interval of {1e3 * shift:.3g} ms later than recorded: that is in the "
        "delay",
        {"shift": shift},
        "where a row has the command of the interval that follows it, that is no delay but how it "
        "was logged: map it with held=after",
    )


def _late_speed(lag: float) -> Finding:
    """Say that the speed alone comes late."""
    return Finding(
        "late_speed",
        "note",
        f"the speed comes {1e3 * lag:.3g} ms later than the current: that is in the delay",
        {"lag": lag},
        "stamp both where they are measured",
    )


def _filtered_speed(fit: Fit) -> Finding:
    """Say over what the speed's sensor averages, or how it low-passes."""
    window, lag = fit.z.window, 0.5 * fit.z.window
    low, ticks, mean = fit.structure.low_pass, fit.structure.ticks, fit.structure.mean
    of = "differences" if mean else "samples"
    pole = lag - 0.5 * mean
    how = (
        f"low-passed with a time constant of {1e3 * pole:.3g} ms"
        + (f", by {ticks} {of} a row" if ticks else "")
        if low
        else f"averaged over {1e3 * window:.3g} ms"
    )
    whose = f"{1e3 * lag:.3g} ms of what looks like a delay is that filter, not the motor"
    either = low and _may_be_the_motors(fit)
    if either:
        whose = "which of the lags is the filter's and which the motor's the data do not tell"
    return Finding(
        "low_passed_speed" if low else "averaged_speed",
        "warning",
        f"the speed is {how}: {whose}",
        {"lag": lag, "samples_per_row": ticks} if low else {"window": window},
        "reverse the motor while recording, or record encoder counts or the current"
        if either
        else "",
    )


def _may_be_the_motors(fit: Fit) -> bool:
    """Tell whether the interval of a filter's lag reaches the slowest of the motor's."""
    if "window" not in fit.structure.free or fit.structure.current:
        return False
    slowest = max(0.5 * z.window for z in exchanged(fit.z, fit.structure.order))
    i = fit.structure.free.index("window")
    reach = 0.5 * NORMAL_95 * float(np.sqrt(fit.covariance()[i, i]))
    return reach > abs(0.5 * fit.z.window - slowest)


def _fit_of_current(data: Experiments, fit: Fit) -> Iterator[Finding]:
    """Say that a current was given up for the speed: each has as large a noise as it takes."""
    if not data.current.size:
        return
    error = data.current - prediction.simulate(data, fit, gain=True)[:, 2]
    explained = 100 * (1 - float(np.nanstd(error)) / max(float(np.nanstd(data.current)), 1e-300))
    if explained >= FIT_EXPLAINS.value or not coloured(error):
        return
    yield Finding(
        "poor_fit_of_current",
        "unreliable",
        f"the model explains only {explained:.0f} % of the current, and the rest is no noise",
        {"fit_percent": explained, "limit": FIT_EXPLAINS.value},
        "check that speed and current are of this motor, and that neither is filtered",
    )


def _current_lag(sensor: str, lag: float) -> Finding:
    """Say how the current's sensor is late."""
    how = {
        "averaged": f"its mean over {2e3 * lag:.3g} ms",
        "low_passed": f"a low-pass of it with a time constant of {1e3 * lag:.3g} ms",
        "smoothed": f"its samples exponentially smoothed, {1e3 * lag:.3g} ms late on average",
    }[sensor]
    return Finding(
        "current_lag",
        "note",
        f"the current is read as {how}: L/R is stated without that lag of its sensor",
        {"lag": lag, "sensor": sensor},
    )
