"""Compiles the simulators of many runs with numba; they call the core (native/link.c).

The compiled code is kept in the user's cache; see :mod:`noack.core.code_cache`.
"""

import importlib
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from noack.core import core_library
from noack.core.code_cache import CALLED_BY_CODE, cache_folder, compiler
from noack.runtime.native import object_code

# No reference counting: nothing is allocated, and counting references to the arrays of a batch at
# each call would take longer than a decision.
_OPTIONS = {**CALLED_BY_CODE, "_nrt": False, "forceinline": True}


@cache
def compile_kept(
    function: Callable[..., Any], name: str, modules: tuple[ModuleType, ...]
) -> Callable[..., Any]:
    """Compile a function, which runs without the interpreter lock.

    The function must not allocate: no new arrays, lists or strings.

    Args:
        function: the function.
        name: name of its cache folder.
        modules: the modules with the functions that it calls, and those on which these depend.
    """
    from numba.extending import register_jitable

    object_code.load_core()
    calls = importlib.import_module("noack.runtime.native.libc_calls")  # loads the compiler
    for module in (calls, *modules):
        for _, one in inspect.getmembers(module, inspect.isfunction):
            if one.__module__ == module.__name__:
                register_jitable(**_OPTIONS)(one)
    files = (__file__, *(one.__file__ for one in (calls, *modules)))
    folder = cache_folder(name, [core_library.LIBRARY, *(Path(str(one)) for one in files)])
    compiled: Callable[..., Any] = compiler(folder, nogil=True, _nrt=False)(function)
    return compiled
