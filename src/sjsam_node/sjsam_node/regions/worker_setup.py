# SPDX-License-Identifier: Apache-2.0
"""Setup of each worker of a Dask cluster, also of one that comes later or is started again; imports ``distributed``."""

from __future__ import annotations

from distributed import Worker, WorkerPlugin

from slam_core.runtime.blas_threads import use_one_blas_thread


class OneBlasThread(WorkerPlugin):
    """Gives each worker one thread of BLAS, unless its environment names a number."""

    name = "indoor-slam-one-blas-thread"

    def setup(self, worker: Worker) -> None:
        """Called on a worker before its first task."""
        use_one_blas_thread()
