"""How the simulator's inner loops are compiled: numba, without fast-math, so that results are the same everywhere.

Compiled code is cached beside the source or, where that cannot be written, in the user's cache directory; where
neither can be, it is compiled again in every process. Kernels that call each other stay in one file, since numba
notices only changes of the file that a cached function is in.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """Compile `function` on first use; it releases the interpreter lock while it runs."""
    import numba

    try:
        compiled: F = numba.njit(nogil=True, cache=True)(function)
    except RuntimeError:  # numba found no place for its cache
        compiled = numba.njit(nogil=True)(function)
    return compiled
