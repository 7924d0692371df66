# SPDX-License-Identifier: Apache-2.0
"""Entry points; each handles Ctrl-C from before its imports."""

import importlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from types import FrameType

# One thread for linear algebra: with two, OpenBLAS waits in a busy loop, which under SCHED_FIFO
# may never end.
for _library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")


_PIP_NAMES = {"yaml": "pyyaml", "numba": "numba==0.61.2"}
"""Distribution names that differ from the module's."""

_ROS_MODULES = ("ament_index_python", "builtin_interfaces", "rcl_interfaces", "rpyutils")

MAX_DOMAIN_ID = 232  # highest domain whose ports stay below 65536 (DDSI-RTPS 2.5, section 9.6.1.1)


def _make_program(module: str, interrupt_code: int) -> Callable[[], int]:
    """Return a function that runs a module's ``main``; an early Ctrl-C gives ``interrupt_code``."""

    def run() -> int:
        try:
            return importlib.import_module(module).main() or 0
        except KeyboardInterrupt:
            return interrupt_code
        except ImportError as error:
            if is_interrupt(error):
                return interrupt_code
            if os.environ.get("SMP_DEBUG") or not isinstance(error, ModuleNotFoundError):
                raise
            print(f"{module.rpartition('.')[2]}: {explain_missing_module(error)}", file=sys.stderr)
            return 2

    return run


def is_interrupt(error: BaseException | None) -> bool:
    """Return whether Ctrl-C caused an error, as in the import of a compiled module."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def explain_missing_module(error: ModuleNotFoundError) -> str:
    """Return a one-line remedy for a missing module."""
    name = (error.name or "").partition(".")[0]
    if name == "smp_interfaces":
        return "smp_interfaces is not found; build both packages of the repository and source them"
    if name in ("rclpy", "launch", *_ROS_MODULES) or name.endswith("_msgs"):
        return f"{name} is not found; source ROS 2 Jazzy and the workspace, or setup.bash"
    import sysconfig

    marker = os.path.join(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED")
    marked = sys.prefix == sys.base_prefix and os.path.isfile(marker)
    command = f"pip install{' --break-system-packages' if marked else ''}"
    package = _PIP_NAMES.get(name, name)
    return f"the Python package {name} is not installed; type: {command} {package}"


def node(name: str, package: str = "smp_motor_control") -> Callable[[], int]:
    """Return a function that runs a node until a signal and returns the exit code."""
    program = _make_program(f"{package}.nodes.{name}", 0)

    def run() -> int:
        if wrong := find_domain_problem():
            print(f"{name}: {wrong}", file=sys.stderr)
            return 2
        # record and play parse their own arguments and print their own help.
        if name not in ("record", "play") and {"-h", "--help"} & set(sys.argv[1:]):
            sys.argv[1:] = [f"{package}.nodes.{name}"]
            return _make_program("smp_motor_control.nodes.usage", 0)()
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _interrupt)
        return program()

    return run


_interrupts: list[int] = []


def _interrupt(number: int, frame: FrameType | None) -> None:
    _interrupts.append(number)
    raise KeyboardInterrupt


def was_interrupted_on_import() -> bool:
    """Return whether Ctrl-C came during the import of a node; some callbacks swallow it."""
    return bool(_interrupts)


def find_domain_problem() -> str:
    """Return an error for an invalid ROS_DOMAIN_ID, which DDS ignores silently; else nothing."""
    domain = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if domain.isdecimal() and int(domain) <= MAX_DOMAIN_ID:
        return ""
    return f"ROS_DOMAIN_ID is {domain!r}; it must be a whole number from 0 to {MAX_DOMAIN_ID}"


def split_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a program's own arguments and those from ``--ros-args`` to ``--``."""
    own: list[str] = []
    ros: list[str] = []
    inside = False
    for argument in argv:
        inside = inside or argument == "--ros-args"
        (ros if inside else own).append(argument)
        inside = inside and argument != "--"
    return own, ros


wheel_pid = node("wheel_pid")
motor_plant = node("motor_plant")
skid_steer = node("skid_steer")
teleop_wheels = node("teleop_wheels")
excite = node("excite")
serial_driver = node("serial_driver")
record = node("record", "smp_motor_ident")
play = node("play", "smp_motor_ident")
identifier = node("identifier", "smp_motor_ident")
identify = _make_program("smp_motor_ident.cli.identify", 130)
tune = _make_program("smp_motor_ident.cli.tune", 130)
commission = _make_program("smp_motor_ident.cli.commission", 130)
demo = _make_program("smp_motor_ident.cli.demo", 130)
lab = _make_program("smp_motor_ident.cli.lab", 130)
