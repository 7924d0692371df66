"""What every command-line tool has in common: one-line errors, exit codes, progress."""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from smp_motor_control.errors import SmpError
from smp_motor_control.ros_arguments import split_arguments
from smp_motor_ident.cli.interruption import interruptible

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaint is one line."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2.

        Parameters
        ----------
        message : str
            What is wrong with the arguments.
        """
        self.exit(2, f"{self.prog}: {message}; '{self.prog} --help' shows the usage\n")


def run(
    parser: argparse.ArgumentParser,
    work: Callable[[argparse.Namespace], int | None],
    argv: Sequence[str] | None,
) -> int:
    """Parse, do the work, and turn whatever happens into a line and an exit code.

    Parameters
    ----------
    parser : argparse.ArgumentParser
        Of the tool.
    work : callable
        From the parsed arguments to an exit code; None is 0.
    argv : sequence of str or None
        Arguments; None takes those of the process.

    Returns
    -------
    int
        0 done, 1 the data do not support the answer, 2 wrong usage or unreadable input.
    """
    try:
        own, ros = split_arguments(sys.argv[1:] if argv is None else argv)
        arguments = parser.parse_args(own)
        arguments.ros_arguments = ros
    except SystemExit as end:
        return int(end.code or 0)
    try:
        with interruptible(), warnings.catch_warnings():
            # Numerics that fail are dealt with where they occur; standard error is for the user.
            warnings.simplefilter("ignore", RuntimeWarning)
            code = work(arguments) or 0
        sys.stdout.flush()
        return code
    except SmpError as error:
        return _fail(parser.prog, str(error), error.exit_code)
    except KeyboardInterrupt:
        return _fail(parser.prog, "interrupted", INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output (head, less) has gone; nobody is left to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if os.environ.get("SMP_DEBUG"):
            raise
        told = f"{type(error).__name__}: {error}".replace("\n", " ")
        return _fail(parser.prog, f"a defect of this tool: {told} (SMP_DEBUG=1 shows where)", 2)


def _fail(program: str, message: str, code: int) -> int:
    print(f"{program}: {message}", file=sys.stderr, flush=True)
    return code


@contextmanager
def progress(program: str, quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Show what takes time: a moving line on a terminal, a line per slow step elsewhere."""
    console = Console(stderr=True)
    if quiet:
        yield lambda text: None
    elif console.is_terminal:
        columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as line:
            task = line.add_task("")
            yield lambda text: line.update(task, description=text)
    else:
        with _lines(program) as say:
            yield say


@contextmanager
def _lines(program: str, patience: float = 2.0) -> Iterator[Callable[[str], None]]:
    """Print each step that is still going on after `patience` seconds, once."""
    begun: list[tuple[str, float]] = []
    told: set[int] = set()
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.25):
            k = len(begun) - 1
            if k >= 0 and k not in told and time.monotonic() - begun[k][1] > patience:
                told.add(k)
                print(f"{program}: {begun[k][0]} ...", file=sys.stderr, flush=True)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield lambda text: begun.append((text, time.monotonic()))
    finally:
        over.set()
        watcher.join()
