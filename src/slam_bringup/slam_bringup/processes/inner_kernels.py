# SPDX-License-Identifier: Apache-2.0
"""Kernels that only other kernels call, compiled without machine code of their own.

Numba makes three things of every kernel: LLVM code, which its callers take in and optimise with theirs, wrappers for
calls from Python and C, and machine code. Of 340 kernels Python calls 100, and the rest needs LLVM code alone: three of
the modules with most work are compiled in 0.80 to 0.84 of the time so.
Kernels without machine code are not cached: where Python calls one after all, as tests do, it is compiled then.
"""

# Numba is annotated in part only.
# mypy: disable-error-code="attr-defined"

from __future__ import annotations

from collections.abc import Container
from typing import Any

from numba import _dynfunc
from numba.core.caching import Cache
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext
from numba.core.dispatcher import _FunctionCompiler

from slam_core.runtime.kernel_cache import is_known_numba

_NOWHERE = 0
"""Address of a kernel that this process never calls."""


def compile_in_full_only(names: Container[tuple[str, str]]) -> None:
    """Make LLVM code alone of kernels not in ``names`` (module, name), in this process, which must call none of them.

    Another Numba than those known compiles all in full, as it always does.
    """
    if not is_known_numba():
        return
    customize: Any = _FunctionCompiler._customize_flags
    finalize: Any = CPUCodeLibrary._finalize_final_module
    executable: Any = CPUContext.get_executable
    save: Any = Cache.save_overload

    def is_inner(function: Any) -> bool:
        return (function.__module__, function.__name__) not in names

    def flags_of(compiler: Any, flags: Any) -> Any:
        flags = customize(compiler, flags)
        flags.no_cfunc_wrapper = True
        flags.no_cpython_wrapper = is_inner(compiler.py_func)
        return flags

    def finalize_module(library: Any) -> None:
        is_loaded = getattr(library, "_compiled_object", None) is not None
        if is_loaded or getattr(library, "_is_called_by_python", False):
            finalize(library)
        else:
            library._finalize_dynamic_globals()
            library._finalized = True

    def executable_of(context: Any, library: Any, description: Any, environment: Any) -> Any:
        if library._finalized or _defines(library, description.llvm_cpython_wrapper_name):
            library._is_called_by_python = True
            return executable(context, library, description, environment)
        library._ensure_finalized()
        name = description.qualname.split(".")[-1]
        return _dynfunc.make_function(description.lookup_module(), name, "", _NOWHERE, environment, (library,))

    def save_overload(cache: Any, signature: Any, result: Any) -> None:
        if not is_inner(cache._py_func):
            save(cache, signature, result)

    patched: Any
    for patched, name, replacement in (
        (_FunctionCompiler, "_customize_flags", flags_of),
        (CPUCodeLibrary, "_finalize_final_module", finalize_module),
        (CPUContext, "get_executable", executable_of),
        (Cache, "save_overload", save_overload),
    ):
        setattr(patched, name, replacement)


def _defines(library: Any, name: str) -> bool:
    try:
        return not library.get_function(name).is_declaration
    except NameError:
        return False
