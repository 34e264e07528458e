"""How the simulator's inner loops are compiled: numba, without fast-math, so that results are the same everywhere.

Compiled code is cached beside the source or, where that cannot be written, in the user's cache directory; where
neither can be, it is compiled again in every process. Kernels that call each other stay in one file, since numba
notices only changes of the file that a cached function is in.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` on first use; it releases the interpreter lock while it runs.

    It must not allocate: numba's counting of references to arrays is off, since it costs more than the work itself.
    """
    return _cached(function, _nrt=False)


def allocating(function: F) -> F:
    """Compile a function that allocates arrays, and does so rarely."""
    return _cached(function)


def inlined(function: F) -> F:
    """Compile a part of a kernel into its callers."""
    return _compiled(function, forceinline=True, _nrt=False)


def _cached(function: F, **options: bool) -> F:
    try:
        return _compiled(function, cache=True, **options)
    except RuntimeError:  # numba found no place for its cache
        return _compiled(function, **options)


def _compiled(function: F, **options: bool) -> F:
    jit: Any = numba.njit  # its types know nothing of `_nrt`
    compiled: F = jit(nogil=True, **options)(function)
    return compiled
