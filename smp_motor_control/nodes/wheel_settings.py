"""Parameters of ``wheel_pid``, and the settings of its core that they make."""

from dataclasses import dataclass, field
from typing import Any

from smp_motor_control.errors import ParameterError
from smp_motor_control.motor.model import MotorModel
from smp_motor_control.nodes.settings import described, fields_for, fixed, nested
from smp_motor_control.observer import ObserverNoise
from smp_motor_control.pid import PidGains
from smp_motor_control.reference.profile import Drive, ProfileLimits
from smp_motor_control.wheel.controller import WheelSettings
from smp_motor_control.wheel.faults import FaultLimits
from smp_motor_control.wheel.loop import LoopSettings


def _of(group: str, name: str, description: str) -> Any:
    return described(0.0, description, minimum=0.0, name=f"{group}.{name}")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Parameters of the node."""

    joint_name: str = fixed("", "Joint to control; empty for <namespace>_wheel_joint.")
    autostart: bool = fixed(True, "Configure and activate without being asked to.")
    setpoint_timeout: float = described(
        0.5, "Silence of set-points after which the wheel is braked [s].", minimum=0.01,
        maximum=60.0,
    )  # fmt: skip
    feedback_timeout: float = described(
        0.2, "Silence or age of feedback after which the voltage is zero [s].",
        minimum=0.005, maximum=10.0,
    )  # fmt: skip
    gains: PidGains = nested(PidGains())
    max_velocity: float = described(0.0, "Of the reference [rad/s]; 0 for none.", minimum=0.0)
    max_acceleration: float = described(0.0, "Of the reference [rad/s^2]; 0 for none.", minimum=0.0)
    max_jerk: float = described(0.0, "Of the reference [rad/s^3]; 0 for none.", minimum=0.0)
    transition_time: float = described(
        0.0, "Duration of every change of set-point [s]; 0: as fast as limits allow.",
        minimum=0.0, maximum=60.0,
    )  # fmt: skip
    reference_delay: float = described(
        0.0, "Lag of the measured speed behind the reference: delay and averaging [s].",
        minimum=0.0, maximum=10.0,
    )  # fmt: skip
    reference_doubt: float = described(
        0.0, "By which that lag may be wrong [s].", minimum=0.0, maximum=1.0
    )
    drive_top_speed: float = _of(
        "drive",
        "top_speed",
        "Speed at which the voltage for changes is used up [rad/s]; 0: no limit.",
    )
    drive_time_constant: float = _of(
        "drive", "time_constant", "Sum of the time constants that changes are made for [s]."
    )
    drive_time_constant_product: float = _of(
        "drive", "time_constant_product", "Their product [s^2]."
    )
    speed_source: str = described("measured", "measured, difference or observer.")
    difference_window: int = described(
        4, "Samples to difference counts over.", minimum=1, maximum=1000
    )
    model_dc_gain: float = _of("model", "dc_gain", "Speed per volt [rad/s/V, motor]; 0: no model.")
    model_time_constant: float = _of("model", "time_constant", "Sum of the time constants [s].")
    model_time_constant_product: float = _of(
        "model", "time_constant_product", "Their product [s^2]."
    )
    model_static_voltage: float = _of("model", "static_voltage", "What dry friction takes [V].")
    model_delay: float = _of("model", "delay", "From voltage to effect [s].")
    observer: ObserverNoise = nested(ObserverNoise(), prefix="observer.")
    faults: FaultLimits = nested(FaultLimits())
    fault_retry: float = described(
        2.0, "Pause before a wheel at fault is tried again under a set-point that is not zero "
        "[s], doubled every time, three times at most; 0: only after a zero set-point.",
        minimum=0.0, maximum=3600.0,
    )  # fmt: skip
    implausible_velocity: float = described(
        1000.0, "Feedback beyond this speed is left out [rad/s, wheel].", minimum=0.0
    )
    scheduling_priority: int = fixed(
        0, "SCHED_FIFO priority; 0 for the usual scheduler.", minimum=0, maximum=99
    )
    cpu_affinity: tuple[int, ...] = fixed((-1,), "Processors to run on; -1 for any.")
    wheel: WheelSettings = field(init=False, repr=False)  # what they make of the controller

    def __post_init__(self) -> None:
        limits = ProfileLimits.from_parameters(
            self.max_velocity, self.max_acceleration, self.max_jerk
        )
        loop = LoopSettings(
            **fields_for(LoopSettings, self),
            limits=limits,
            drive=self._drive(),
            model=self._motor_model(),
            noise=self.observer,
        )
        wheel = WheelSettings(**fields_for(WheelSettings, self), loop=loop)
        object.__setattr__(self, "wheel", wheel)

    def _drive(self) -> Drive | None:
        if self.drive_top_speed == 0.0:
            return None
        return Drive(**fields_for(Drive, self, "drive_"))

    def _motor_model(self) -> MotorModel | None:
        given = (self.model_dc_gain, self.model_time_constant)
        if given == (0.0, 0.0):
            return None
        if 0.0 in given:
            raise ParameterError("model.dc_gain and model.time_constant must be given together")
        return MotorModel(**fields_for(MotorModel, self, "model_"))
