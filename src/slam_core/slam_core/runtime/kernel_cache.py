# SPDX-License-Identifier: Apache-2.0
"""Kernels from Numba's cache take their machine code alone: half the memory, two thirds of the time to load.

A cached kernel comes with its LLVM code too, for kernels that are yet to be compiled and call it. Numba parses that of
every kernel that it loads and keeps it, 0.4 MB each. Here it stays packed until somebody asks, which nobody does once
all kernels are compiled (``slam warmup``). Which functions a kernel defines is read from its machine code instead.
Nor does machine code look up global names, so those of Numba's own modules whose functions a kernel has are not loaded:
0.05 s and 6 MB.

Without it ``slam run`` of 200 frames of a depth camera with scan odometry takes 352 MB instead of 301 and a sixth more
processor time (39 s instead of 31 and 32, three runs each, other work beside); ``bags/demo`` 287 MB instead of 280.
"""

from __future__ import annotations

import struct
import zlib
from functools import cache
from typing import Any

import numba
import numpy as np
from llvmlite import binding as llvm
from numba.core import environment
from numba.core.caching import Cache
from numba.core.codegen import CPUCodeLibrary
from numba.core.runtime.nrt import rtsys

_KNOWN = tuple(f"0.{minor}." for minor in range(61, 69))
"""Releases of Numba whose cache is laid out so; another one loads its kernels as it always does."""
_FASTEST = 1
"""Level of compression."""
_ELF = b"\x7fELF\x02\x01"
"""First bytes of an object file of Linux, 64 bits, little endian."""
_SECTION = np.dtype([("name", "<u4"), ("kind", "<u4"), ("flags", "<u8"), ("address", "<u8"), ("offset", "<u8"),
                     ("size", "<u8"), ("link", "<u4"), ("rest", "V20")])  # fmt: skip
_SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("at", "<u8"), ("size", "<u8")]
)
_SYMBOL_TABLE = 2


def is_known_numba() -> bool:
    """True if this release of Numba is one whose inner workings are known here."""
    return bool(numba.__version__.startswith(_KNOWN))


def load_machine_code_alone() -> None:
    """Have kernels loaded so from now on, in this process; a second call, or another Numba, changes nothing."""
    if is_known_numba():
        CPUCodeLibrary._unserialize = classmethod(_unserialize)  # type: ignore[method-assign,assignment]
        Cache.load_overload = _load_overload  # type: ignore[method-assign]
        environment._rebuild_env = _rebuild_environment  # type: ignore[assignment]


_load_all = CPUCodeLibrary._unserialize.__func__  # type: ignore[attr-defined]
_rebuild_with_globals: Any = environment._rebuild_env
_environments: Any = environment.Environment._memo


def _load_overload(cache: Any, signature: Any, target: Any) -> Any:
    """In place of Numba's: what is cached for a signature, or None.

    Numba first loads all that it can compile, 0.15 s and 8 MB. Who compiles does so, too; machine code needs the
    runtime alone.
    """
    rtsys.initialize(target)
    with cache._guard_against_spurious_io_errors():
        return cache._load_overload(signature, target)
    return None


def _rebuild_environment(module: str, constants: list[Any], name: str) -> Any:
    """In place of Numba's: a function's constants, and its module's global names unless that is one of Numba's own."""
    if not module.startswith("numba.") or name in _environments:
        return _rebuild_with_globals(module, constants, name)
    made = environment.Environment({"__name__": module})
    made.consts[:] = constants
    made.env_name = name
    _environments[name] = made
    return made


def _unserialize(cls: Any, codegen: Any, state: tuple[str, str, Any]) -> Any:
    """In place of Numba's: a compiled library from what the cache holds."""
    name, kind, data = state
    if kind != "object" or not data[0].startswith(_ELF):
        return _load_all(cls, codegen, state)
    machine_code, llvm_code = data
    library = _load_all(cls, codegen, (name, kind, (machine_code, _nothing())))
    codegen._engine._defined_symbols |= defined_symbols(machine_code)
    packed = zlib.compress(llvm_code, _FASTEST)

    @cache
    def module_for_linking() -> Any:
        return llvm.parse_bitcode(zlib.decompress(packed))

    library._get_module_for_linking = module_for_linking
    return library


@cache
def _nothing() -> bytes:
    """LLVM code of an empty module."""
    return bytes(llvm.parse_assembly("").as_bitcode())


def defined_symbols(elf: bytes) -> set[str]:
    """Names of the functions and variables that an object file (ELF, 64 bits) defines for others."""
    (first,) = struct.unpack_from("<Q", elf, 0x28)
    (count,) = struct.unpack_from("<H", elf, 0x3C)
    sections = np.frombuffer(elf, _SECTION, count, first)
    names: set[str] = set()
    for table in sections[sections["kind"] == _SYMBOL_TABLE]:
        symbols = np.frombuffer(elf, _SYMBOL, int(table["size"]) // _SYMBOL.itemsize, int(table["offset"]))
        text = int(sections[int(table["link"])]["offset"])
        for at in symbols["name"][(symbols["section"] != 0) & (symbols["info"] >> 4 != 0)].tolist():
            names.add(elf[text + at : elf.index(b"\0", text + at)].decode())
    return names
