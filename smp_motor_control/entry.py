"""The executables: each imports its program while it already listens to Ctrl-C."""

import importlib.util
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

# One thread for linear algebra: our matrices are small, and the library waits for a second
# thread in a busy loop, which under SCHED_FIFO may never end.
for _library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")


_PIP = {"yaml": "pyyaml", "numba": "numba==0.61.2"}
"""What pip calls a module otherwise."""

_ROS = ("ament_index_python", "builtin_interfaces", "rcl_interfaces", "rpyutils")

_OF_TOOLS = ("numpy", "scipy", "numba", "yaml", "rosbags", "msgspec", "rich")
"""What a tool imports, some of it only while it works: looked for before it begins."""

MOST_DOMAIN = 232
"""DDSI-RTPS 2.5, section 9.6.1.1: the ports of a higher domain lie beyond 65535."""


def _program(module: str, interrupted: int) -> Callable[[], int]:
    """Return what runs ``main`` of a module, and its exit code where Ctrl-C came before that."""

    def run() -> int:
        try:
            return importlib.import_module(module).main() or 0
        except KeyboardInterrupt:
            return interrupted
        except ImportError as error:
            if was_interrupted(error):
                return interrupted
            if os.environ.get("SMP_DEBUG") or not isinstance(error, ModuleNotFoundError):
                raise
            print(f"{module.rpartition('.')[2]}: {missing(error)}", file=sys.stderr)
            return 2

    return run


def was_interrupted(error: BaseException | None) -> bool:
    """Whether an import failed because Ctrl-C came while a compiled module was made ready."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def missing(error: ModuleNotFoundError) -> str:
    """Return what to do about a module that is not installed, in one line."""
    name = (error.name or "").partition(".")[0]
    if name == "smp_interfaces":
        return "smp_interfaces is not built or not sourced; build both packages of the repository"
    if name in ("rclpy", "launch", *_ROS) or name.endswith("_msgs"):
        return f"{name} is not there; source ROS 2 Jazzy and the workspace, or setup.bash"
    return f"the Python package {name} is not installed; type: {_pip()} {_PIP.get(name, name)}"


def _pip() -> str:
    """Return the command that installs: Ubuntu's Python refuses pip without an option (PEP 668)."""
    import sysconfig

    marker = os.path.join(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED")
    marked = sys.prefix == sys.base_prefix and os.path.isfile(marker)
    return f"pip install{' --break-system-packages' if marked else ''}"


def node(name: str, package: str = "smp_motor_control") -> Callable[[], int]:
    """Return what runs the node of that name until a signal, and returns the exit code."""
    program = _program(f"{package}.nodes.{name}", 0)

    def run() -> int:
        if wrong := wrong_domain():
            print(f"{name}: {wrong}", file=sys.stderr)
            return 2
        # Those of bags have arguments of their own, and their own help.
        if name not in ("record", "play") and {"-h", "--help"} & set(sys.argv[1:]):
            sys.argv[1:] = [f"{package}.nodes.{name}"]
            return _program("smp_motor_control.nodes.usage", 0)()
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _interrupt)
        return program()

    return run


_interrupts: list[int] = []


def _interrupt(number: int, frame: FrameType | None) -> None:
    _interrupts.append(number)
    raise KeyboardInterrupt


def interrupted() -> bool:
    """Tell whether Ctrl-C came while a node was imported: Python drops it in some callbacks."""
    return bool(_interrupts)


def wrong_domain() -> str:
    """Return what is wrong with ROS_DOMAIN_ID, of which DDS itself says nothing; else nothing."""
    domain = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if domain.isdecimal() and int(domain) <= MOST_DOMAIN:
        return ""
    return f"ROS_DOMAIN_ID is {domain!r}; it must be a whole number from 0 to {MOST_DOMAIN}"


def _tool(name: str, *more: str) -> Callable[[], int]:
    program = _program(f"smp_motor_ident.cli.{name}", 130)

    def run() -> int:
        for module in (*_OF_TOOLS, *more):
            if importlib.util.find_spec(module) is None:
                print(f"{name}: {missing(ModuleNotFoundError(name=module))}", file=sys.stderr)
                return 2
        return program()

    return run


wheel_pid = node("wheel_pid")
motor_plant = node("motor_plant")
skid_steer = node("skid_steer")
teleop_wheels = node("teleop_wheels")
excite = node("excite")
serial_driver = node("serial_driver")
record = node("record", "smp_motor_ident")
play = node("play", "smp_motor_ident")
identifier = node("identifier", "smp_motor_ident")
identify = _tool("identify")
tune = _tool("tune")
commission = _tool("commission", "mcap")
demo = _tool("demo", "mcap")
