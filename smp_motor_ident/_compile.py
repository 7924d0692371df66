"""One typed door to numba, so that compiled functions keep their signatures for mypy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "nogil": True,
    "fastmath": {"contract", "nsz", "arcp", "reassoc"},
}


def compiled(function: F) -> F:
    """Compile a function to machine code on its first call and keep it on disk.

    Floating-point sums may be regrouped; NaN keeps its meaning.

    Parameters
    ----------
    function : callable
        Of scalars and numpy arrays.

    Returns
    -------
    callable
        The same function, compiled; the signature is unchanged.
    """
    return cast(F, numba.njit(**OPTIONS)(function))


def inlined(function: F) -> F:
    """Compile a function into its callers: for the few that are called at every sample.

    Parameters
    ----------
    function : callable
        Of scalars and numpy arrays.

    Returns
    -------
    callable
        The same function, compiled; the signature is unchanged.
    """
    return cast(F, numba.njit(forceinline=True, **OPTIONS)(function))
