# SPDX-License-Identifier: Apache-2.0
"""Choice of the device that SURF is computed on: the CPU, or through OpenCL a GPU, until that fails.

pyopencl, an optional requirement, is loaded only where another device than the CPU is asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

CPU = "cpu"
AUTO = "auto"
GPU = "gpu"

T = TypeVar("T")


def best_opencl_device() -> tuple[str, bool] | None:
    """Name of a GPU, else of any other OpenCL device, and whether it is a GPU; None where there is none."""
    try:
        from stereo_frontend.surf import opencl_surf  # which needs pyopencl
    except ImportError:
        return None
    devices = opencl_surf.known_devices()
    return (devices[0].name.strip(), opencl_surf.is_gpu(devices[0])) if devices else None


class SurfDevice:
    """The device on which SURF is computed; the CPU where there is none, and from the first failure on.

    Parameters
    ----------
    wanted
        "cpu"; "gpu", the first GPU; "auto", the same, but without a word where there is none; else a part of the
        name of an OpenCL device of any kind, or of its platform.
    """

    def __init__(self, wanted: str = CPU) -> None:
        self.name = CPU
        """The device in use."""
        self.diagnostic = ""
        """Reason for which it is not the one that was asked for, or ""."""
        self._surf: Any = None
        self._errors: tuple[type[Exception], ...] = ()
        if wanted != CPU:
            self._open(wanted)

    def _open(self, wanted: str) -> None:
        try:
            from stereo_frontend.surf import opencl_surf  # which needs pyopencl
        except ImportError as error:
            if wanted != AUTO:
                self._fall_back(f"{error} (pip install pyopencl)")
            return
        self._errors = opencl_surf.DEVICE_ERRORS
        try:
            device = opencl_surf.find_device("" if wanted in (AUTO, GPU) else wanted)
            self._surf, self.name = opencl_surf.OpenClSurf(device), device.name.strip()
        except LookupError as error:
            if wanted != AUTO:
                self._fall_back(str(error))
        except self._errors as error:
            self._fall_back(f"{device.name.strip()}: {error}")

    def compute(self, on_device: Callable[[Any], T], on_cpu: Callable[[], T]) -> T:
        """Result of ``on_device``, given an :class:`~stereo_frontend.surf.opencl_surf.OpenClSurf`, or of ``on_cpu``."""
        surf, name = self._surf, self.name
        if surf is not None:
            try:
                return on_device(surf)
            except self._errors as error:
                self._fall_back(f"{name}: {error}")
        return on_cpu()

    def _fall_back(self, why: str) -> None:
        self.name, self._surf = CPU, None
        # Both images of a pair may find out; the first has the reason.
        self.diagnostic = self.diagnostic or f"SURF is computed on the CPU: {why.splitlines()[0]}"
