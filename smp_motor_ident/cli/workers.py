# SPDX-License-Identifier: Apache-2.0
"""Run independent jobs in parallel, in as many processes as there are cores."""

import ctypes
import gc
import multiprocessing
import os
import signal
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from smp_motor_ident.errors import BagError

Result = TypeVar("Result")
Say = Callable[..., None]

_LIBC, _PR_SET_PDEATHSIG = ctypes.CDLL(None), 1
_JOBS: dict[str, Callable[[Say], Any]] = {}


def in_parallel(
    jobs: Mapping[str, Callable[[Say], Result]], say: Say, doing: str = "estimating"
) -> dict[str, Result]:
    """Run every job in a forked process, which shares the loaded modules."""
    cores = min(len(os.sched_getaffinity(0)), len(jobs))
    if cores < 2:
        return {n: job(lambda text, n=n: say(f"{n}: {text}")) for n, job in jobs.items()}
    say(f"{doing} {', '.join(jobs)}")
    _JOBS.update(jobs)
    gc.freeze()  # what is loaded stays shared: a collection in a child would copy its pages
    fork = multiprocessing.get_context("fork")
    pool = ProcessPoolExecutor(cores, mp_context=fork, initializer=end_with_parent)
    try:
        futures: dict[Future[Result], str] = {pool.submit(_do, name): name for name in jobs}
        done = {}
        for future in as_completed(futures):
            done[futures[future]] = future.result()
            left = [name for name in jobs if name not in done]
            say(f"{doing} {', '.join(left)}", len(done) / len(jobs))
        return {name: done[name] for name in jobs}
    except BrokenProcessPool:
        raise BagError(
            "a worker process was killed, perhaps for lack of memory; free memory, or identify "
            "fewer recordings at once"
        ) from None
    finally:
        _JOBS.clear()
        for worker in multiprocessing.active_children():
            worker.terminate()
        pool.shutdown(cancel_futures=True)


def _do(name: str) -> Any:
    return _JOBS[name](lambda text: None)


def end_with_parent() -> None:
    """Leave Ctrl-C to the parent, and end when it does, however that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if signal.getsignal(signal.SIGTSTP) is not signal.SIG_DFL:  # as Ctrl-C, see `connect`
        signal.signal(signal.SIGTSTP, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    die_with_parent(signal.SIGKILL)


def die_with_parent(number: int) -> None:
    """Let the kernel send this process a signal when its parent dies."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, number)
