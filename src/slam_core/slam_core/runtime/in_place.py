# SPDX-License-Identifier: Apache-2.0
"""``@in_place()`` for compiled kernels that neither make nor return arrays: they only read and fill those they get.

Numba counts the references to every view that a kernel takes, ``image[row]`` say, in atomic steps. In loops over rows
and samples these took 5 % of a run. Whoever owns the arrays holds them through the call anyway, so such kernels do
without. Making an array in one of them is an error of compilation; so is the call of a function that makes one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

from slam_core.runtime.kernel_cache import load_machine_code_alone

load_machine_code_alone()


def in_place(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``njit`` with cache, without the interpreter's lock and without counting references; ``options`` go to it."""
    make: Any = njit
    decorator: Callable[[Callable[..., Any]], Any] = make(cache=True, nogil=True, _nrt=False, **options)
    return decorator
