# SPDX-License-Identifier: Apache-2.0
"""Common code of all command-line tools: one-line errors, exit codes, progress."""

import argparse
import gc
import importlib
import io
import os
import shlex
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from smp_motor_control.entry import split_arguments
from smp_motor_control.errors import SmpError
from smp_motor_ident.cli.interruption import check, interruptible

INTERRUPTED = 130  # exit code after Ctrl-C, as shells have it
# Without a terminal a step is printed when it has lasted TIMEOUT_S, or after SILENCE_S.
TIMEOUT_S = 2.0
SILENCE_S = 4.0

ROS_HELP = "A robot in a namespace: end the line with --ros-args -r __ns:=/robot1."
"""Help on namespaces, for tools that connect to a running robot."""

Work = Callable[[argparse.Namespace], int | None]
"""From the parsed arguments to an exit code; None is 0."""


class Parser(argparse.ArgumentParser):
    """An argument parser with one-line errors."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message}; '{self.prog} --help' shows the usage\n")


class _Output:
    """Standard output that ignores a closed pipe (head, less), so that a tool finishes its work."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _guarded(self, call: Callable[..., Any], *given: Any) -> Any:
        try:
            return call(*given)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def write(self, text: str) -> int:
        """Write, or drop the text if the reader is gone."""
        self._guarded(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush, or drop the text if the reader is gone."""
        self._guarded(self._stream.flush)


def run(made: Callable[[], Parser], work: Work | str, argv: Sequence[str] | None = None) -> int:
    """Parse the arguments, run the tool, and turn errors into a line and an exit code."""
    parser, before = made(), sys.stdout
    stream = before or open(os.devnull, "w")  # noqa: SIM115  (closed by the shell: None)
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="backslashreplace")  # a path may not be UTF-8
    sys.stdout = _Output(stream)
    try:
        given = sys.argv[1:] if argv is None else argv
        own, ros = split_arguments(given)
        arguments = parser.parse_args(own)
        arguments.command, arguments.ros_arguments = shlex.join((parser.prog, *given)), ros
        with interruptible(), warnings.catch_warnings():
            # Numerical failures are handled where they occur; standard error is for the user.
            warnings.simplefilter("ignore", RuntimeWarning)
            code = _run_work(work, arguments)
        sys.stdout.flush()
        return code
    except SystemExit as end:  # the parser has printed the reason
        sys.stdout.flush()
        return int(end.code or 0)
    except SmpError as error:
        return _fail(parser.prog, str(error), error.exit_code)
    except KeyboardInterrupt:
        return _fail(parser.prog, "interrupted", INTERRUPTED)
    except OSError as error:
        return _fail(parser.prog, f"{error.filename or 'output'}: {error.strerror or error}", 2)
    except ModuleNotFoundError:
        raise  # the entry point prints how to install it
    except Exception as error:
        if os.environ.get("SMP_DEBUG"):
            raise
        text = f"{type(error).__name__}: {error}".replace("\n", " ")
        return _fail(parser.prog, f"a defect of this tool: {text} (SMP_DEBUG=1 shows where)", 2)
    finally:
        sys.stdout = before


def _run_work(work: Work | str, arguments: argparse.Namespace) -> int:
    """Do the work; after a Ctrl-C that a callback has dropped, an error counts as that Ctrl-C."""
    try:
        return _load_work(work)(arguments) or 0
    except SmpError:
        raise
    except Exception:
        check()
        raise


def _load_work(work: Work | str) -> Work:
    if not isinstance(work, str):
        return work
    # Wheels are estimated in parallel processes, so linear algebra gets one thread.  Loading
    # modules produces no garbage to collect.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.disable()
    try:
        found: Work = importlib.import_module(f"smp_motor_ident.cli.{work}").work
    finally:
        gc.enable()
    return found


def _fail(program: str, message: str, code: int) -> int:
    print(f"{program}: {message}", file=sys.stderr, flush=True)
    return code


def number(low: float, high: float = float("inf")) -> Callable[[str], float]:
    """Return an argument type for numbers strictly between two limits."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
        if not low < value < high:
            beyond = f"above {low:g}" if high == float("inf") else f"between {low:g} and {high:g}"
            raise argparse.ArgumentTypeError(f"{text} is not {beyond}")
        return value

    return read


@contextmanager
def progress(program: str, quiet: bool = False, takes: str = "") -> Iterator[Callable[..., None]]:
    """Show the progress of long steps as a moving line, or a line each without a terminal.

    The first of these lines tells the expected duration, ``takes``.
    """
    if quiet:
        yield lambda text, share=None: None
    elif sys.stderr.isatty():
        from rich import progress as bars
        from rich.console import Console

        columns = (bars.SpinnerColumn(), "{task.description}", bars.TimeElapsedColumn(), "left")
        left = bars.TimeRemainingColumn()
        with bars.Progress(*columns, left, console=Console(stderr=True), transient=True) as line:
            task = line.add_task("", total=1.0)
            yield lambda text, share=None: line.update(task, description=text, completed=share)
    else:
        with _lines(program, takes) as say:
            yield say


@contextmanager
def _lines(program: str, takes: str) -> Iterator[Callable[..., None]]:
    """Print the present step when it, or the silence, has lasted long."""
    steps: list[tuple[str, float]] = []
    over = threading.Event()

    def watch() -> None:
        printed, since, hint = 0, time.monotonic(), f" (usually {takes})" if takes else ""
        while not over.wait(0.25):
            now = time.monotonic()
            if len(steps) > printed and (now - steps[-1][1] > TIMEOUT_S or now - since > SILENCE_S):
                print(f"{program}: {steps[-1][0]}{hint} ...", file=sys.stderr, flush=True)
                printed, since, hint = len(steps), now, ""

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield lambda text, share=None: steps.append((text, time.monotonic()))
    finally:
        over.set()
        watcher.join()
