# SPDX-License-Identifier: Apache-2.0
"""The number of threads of BLAS: one, as a node has a thread of its own and a run one per stage.

More of them only wait for each other, spinning: the nodes of a rig took 290 ms of processor time a pose instead of 108
and left out four frames of ten. One number of threads also means one order of summation, hence the same bytes.
"""

from __future__ import annotations

import os

from threadpoolctl import threadpool_limits

VARIABLE = "OPENBLAS_NUM_THREADS"


def use_one_blas_thread() -> None:
    """Set one thread for BLAS libraries, loaded or to come, unless the environment gives a number."""
    if VARIABLE not in os.environ:
        os.environ[VARIABLE] = "1"
        threadpool_limits(1, user_api="blas")
