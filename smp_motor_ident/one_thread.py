# SPDX-License-Identifier: Apache-2.0
"""Run linear algebra on one thread, which is faster for matrices of a few columns."""

from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any


def one_thread() -> AbstractContextManager[object]:
    """Return a context in which the linear algebra library runs on one thread.

    The tools set this before they import numpy; a program that imports numpy first needs this.
    """
    pools = _pools()
    return nullcontext() if pools is None else pools.limit(limits=1)


@cache
def _pools() -> Any:
    """Return the libraries' threads; None without threadpoolctl, which apt's numpy does without."""
    try:
        from threadpoolctl import ThreadpoolController
    except ImportError:
        return None
    return ThreadpoolController()
