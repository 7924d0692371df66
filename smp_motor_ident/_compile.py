# SPDX-License-Identifier: Apache-2.0
"""Compile functions by numba with their types kept for mypy, and cache them on the disk."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.runtime import rtsys

F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "nogil": True,
    "fastmath": {"nsz"},
}


UNREADABLE = (ImportError, AttributeError, EOFError, ValueError, pickle.UnpicklingError)
"""Errors of a cache that names what this version does not have, or that is damaged."""


def _stamp() -> tuple[tuple[int, int], ...]:
    """Return a key that changes with any module whose functions are compiled into each other."""
    here = Path(__file__)
    folders = (here.parent / name for name in ("simulate", "chain", "fit", "quality"))
    files = [here, *(file for folder in folders for file in sorted(folder.glob("*.py")))]
    return tuple((file.stat().st_mtime_ns, file.stat().st_size) for file in files)


STAMP = _stamp()


def _stamped(dispatcher: Any) -> Any:
    """Invalidate the cache on disk when any of the modules changes, not only the function's own.

    Numba looks at the file of the outermost function alone: an edit of a function that was
    compiled into it would go unnoticed.
    """
    file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    own = getattr(file, "_source_stamp", None)
    if file is not None and own is not None:
        file._source_stamp = (own, STAMP)
        dispatcher._cache.load_overload = _without_typing(dispatcher._cache)
    return dispatcher


def _without_typing(cache: Any) -> Callable[[Any, Any], Any]:
    """Return a cache's loader that skips numba's typing and lowering rules.

    Numba registers thousands of rules before it looks at the disk.  Cached machine code does not
    need them, and the compiler registers them anyway.
    """

    def load(signature: Any, target: Any) -> Any:
        rtsys.initialize(target)
        try:
            with cache._guard_against_spurious_io_errors():
                return cache._load_overload(signature, target)
        except UNREADABLE:  # left by another version, or cut off: it is compiled again
            cache.flush()
            return None

    return load


def compiled(function: F) -> F:
    """Compile a function to machine code on its first call and keep it on disk.

    Sums are neither regrouped nor fused with products: a function is also compiled into its
    callers, and the order of loading decides which copy runs, so the last digits would differ
    between the first run and the next, and with them the end of a descent on unfitting data.
    """
    return cast(F, _stamped(numba.njit(**OPTIONS)(function)))


def inlined(function: F) -> F:
    """Compile a function into its callers, for functions that run at every sample."""
    return cast(F, _stamped(numba.njit(forceinline=True, **OPTIONS)(function)))
