"""Compiles the pump, and the simulators that call the core, with numba.

The compiled code is kept in the user's cache; see :mod:`noack.core.code_cache`.
"""

import importlib.util
import inspect
import pkgutil
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import netem.engine.pump
from netem import relay_events
from netem.engine import histogram
from noack.core import code_cache, core_library
from noack.core.code_cache import CALLED_BY_CODE, cache_folder, compiler
from noack.protocol import record_tables
from noack.runtime.native import object_code, socket_structs

# No reference counting: nothing is allocated, and counting references to the twenty arrays of
# program and state at each call would take twenty times as long as the decision.
_OPTIONS = {**CALLED_BY_CODE, "_nrt": False, "forceinline": True}


@cache
def compile_rule(function: Callable[..., Any]) -> Any:
    """Compile a function that calls rules; see :func:`compile_kept`."""
    return compile_kept(function, prepare())


def compile_kept(function: Callable[..., Any], folder: Path | None) -> Any:
    """Compile a function, which runs without the interpreter lock.

    The function must not allocate: no new arrays, lists or strings.

    Args:
        function: the function.
        folder: its cache folder, from :func:`prepare`; None if there is no cache.
    """
    return compiler(folder, nogil=True, _nrt=False)(function)


@cache
def prepare(name: str = "netem", modules: tuple[ModuleType, ...] = ()) -> Path | None:
    """Prepare the compilation of the rules and of modules that call them.

    Args:
        name: name of the compiled code.
        modules: the modules with compiled functions, and those on which these depend.

    Returns:
        The cache folder of the compiled code; None if there is no cache.
    """
    if modules:
        prepare()
    _register(modules or [importlib.import_module(rule) for rule, _ in _compiled_modules()])
    return folder(name, modules)


@cache
def folder(name: str = "netem", modules: tuple[ModuleType, ...] = ()) -> Path | None:
    """Return the cache folder, without loading the compiler; see :func:`prepare`."""
    more = (*modules, relay_events, record_tables, object_code, socket_structs)
    sources = [
        __file__,
        str(core_library.HEADER),
        *(path for _, path in _compiled_modules()),
        *(str(one.__file__) for one in more),
    ]
    return cache_folder(name, map(Path, sources))


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether compiled code of a function is in the cache, for this machine."""
    return code_cache.is_kept(prepare(), function)


def _register(modules: Sequence[ModuleType]) -> None:
    from numba.extending import register_jitable

    object_code.load_core()

    for module in modules:
        for _, function in inspect.getmembers(module, inspect.isfunction):
            if function.__module__ == module.__name__:
                register_jitable(**_OPTIONS)(function)


def _compiled_modules() -> Iterator[tuple[str, str]]:
    """Yield the names and files of the modules with compiled functions."""
    for found in pkgutil.walk_packages(netem.engine.pump.__path__, "netem.engine.pump."):
        spec: Any = found.module_finder.find_spec(found.name)  # type: ignore[call-arg]
        yield found.name, spec.origin
    yield histogram.__name__, str(histogram.__file__)
    spec = importlib.util.find_spec("noack.runtime.native.libc_calls")  # loads the compiler
    assert spec is not None
    yield spec.name, str(spec.origin)
