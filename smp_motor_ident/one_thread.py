# SPDX-License-Identifier: Apache-2.0
"""Linear algebra of a few columns on one thread: others would only wait for their share of it."""

from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any


def one_thread() -> AbstractContextManager[object]:
    """Return a context in which the linear algebra library runs on one thread.

    The programs ask for that before they import it; who imports the package after numpy cannot.
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
