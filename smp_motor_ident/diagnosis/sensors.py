"""What a fit says of the sensors: an offset of the current, and over how long they average."""

from __future__ import annotations

from smp_motor_ident.estimation.fit import Fit
from smp_motor_ident.finding import Finding
from smp_motor_ident.model.structures import Electromechanical


def sensors(fit: Fit) -> list[Finding]:
    """Return what was found of the sensors."""
    out = []
    s = fit.structure
    if isinstance(s, Electromechanical) and s.offset:
        offset = fit.z.current_offset
        out.append(
            Finding(
                "current_offset",
                "warning",
                f"current has an offset of {1e3 * offset:.3g} mA, removed",
                {"offset": offset},
                "zero the current sensor at rest",
            )
        )
    if isinstance(s, Electromechanical) and s.lags:
        out.append(_current_lag(s.current_sensor, fit.z.current_lag))
    if s.window or "window" in s.fixed:
        window = fit.z.window
        out.append(
            Finding(
                "averaged_speed",
                "warning",
                f"the speed is averaged over {1e3 * window:.3g} ms: {1e3 * window / 2:.3g} ms of "
                "what looks like a delay is that filter, not the motor",
                {"window": window},
            )
        )
    return out


def _current_lag(sensor: str, lag: float) -> Finding:
    """Say how the current's sensor is late."""
    how = (
        f"its mean over {2e3 * lag:.3g} ms"
        if sensor == "averaged"
        else f"a low-pass of it with a time constant of {1e3 * lag:.3g} ms"
    )
    return Finding(
        "current_lag",
        "note",
        f"the current is read as {how}: L/R is stated without that lag of its sensor",
        {"lag": lag, "sensor": sensor},
    )
