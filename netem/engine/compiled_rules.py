"""Compiles the rules of a link with numba: the same functions that :mod:`netem.link_machine` runs.

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

import numpy as np

import netem.engine.pump
import netem.rules
import noack.impairments
from netem import relay_events
from netem.engine import histogram
from netem.rule_program import empty_state, loss_width, new_flow, recent_width
from noack.core import code_cache
from noack.core.code_cache import CALLED_BY_CODE, cache_folder, compiler
from noack.impairments import link_records
from noack.impairments.link_records import (
    NEVER_NS,
    LinkMemory,
    LinkProgram,
    array_of,
    dtype_of,
    union_dtype,
)
from noack.impairments.stage_dispatch import (
    BEHAVIOURS,
    QUEUE_RECORDS,
    STAGE_RECORDS,
    apply_stage,
)
from noack.protocol import record_tables
from noack.runtime.native import object_code, socket_structs


def compiled_program(program: LinkProgram) -> LinkProgram:
    """Return a program as arrays, for compiled rules; ``stages`` rows have all stages' fields."""
    tables: dict[str, Any] = {
        "stages": array_of(union_dtype(STAGE_RECORDS), program.stages),
        "windows": array_of(dtype_of(link_records.WindowRule), program.windows),
        "decisions": array_of(dtype_of(link_records.RecordedDecision), program.decisions),
        "reals": np.array(program.reals, dtype=np.float64),
    }
    for name in ("integers", "decisions_begin"):
        tables[name] = np.array(getattr(program, name), dtype=np.int64)
    return program._replace(**tables)


def compiled_state(program: LinkProgram, rows: int) -> LinkMemory:
    """Return a state without flows as arrays, with room for ``rows`` flows; see :func:`set_flow`.

    ``program`` is the program before :func:`compiled_program`.
    """
    state = empty_state(program)
    arrays: dict[str, Any] = {
        "flows": np.zeros(rows, dtype_of(link_records.FlowState)),
        "memory": np.zeros((rows, len(program.stages)), dtype_of(link_records.StageMemory)),
        "recent_ns": np.full((rows, recent_width(program)), NEVER_NS, np.int64),
        "losses": np.zeros((rows, loss_width(program)), np.int64),
        "queues": array_of(union_dtype(QUEUE_RECORDS), state.queues),
        "departures_ns": np.array(state.departures_ns, dtype=np.int64),
        "link": array_of(dtype_of(link_records.LinkState), [state.link])[0],
        "counters": array_of(dtype_of(link_records.Counters), [state.counters])[0],
    }
    return LinkMemory(**arrays)


def set_flow(
    state: LinkMemory, row: int, number: int, first_delivered: bool, losses: Sequence[int] = (0,)
) -> None:
    """Initialise a row of a state of arrays for a new flow; ``losses``: see :func:`new_losses`."""
    tables: Any = state
    tables.flows[row] = array_of(tables.flows.dtype, [new_flow(number, first_delivered)])[0]
    tables.memory[row] = np.zeros(1, tables.memory.dtype)
    tables.recent_ns[row] = NEVER_NS
    tables.losses[row] = losses


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
        *(path for _, path in _compiled_modules()),
        *(str(one.__file__) for one in more),
    ]
    return cache_folder(name, map(Path, sources))


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether compiled code of a function is in the cache, for this machine."""
    return code_cache.is_kept(prepare(), function)


def _register(modules: Sequence[ModuleType]) -> None:
    from numba.extending import overload, register_jitable

    for module in modules:
        for _, function in inspect.getmembers(module, inspect.isfunction):
            if function is apply_stage:
                options: Any = _OPTIONS
                overload(apply_stage, jit_options=options)(compiled_dispatch)
            elif function.__module__ == module.__name__:
                register_jitable(**_OPTIONS)(function)


def compiled_dispatch(packet: Any, stage: Any, memory: Any) -> Callable[..., None]:
    """Return :func:`noack.impairments.stage_dispatch.apply_stage` for compiled code.

    It compares a stage's kind with each behaviour's number in order: ``if kind == 0: ... elif kind
    == 1: ...``; the compiler makes a jump table of it.
    """
    return _comparisons()


@cache
def _comparisons() -> Callable[..., None]:
    """Return the comparisons as one function, made from text.

    Functions that call each other, one for each comparison, would take half of the compilation: the
    compiler translates each with all that it calls.
    """
    lines = ["def dispatch(packet: Any, stage: Any, memory: Any):"]
    for kind in range(len(BEHAVIOURS)):
        lines += [f" {'elif' if kind else 'if'} stage.kind == {kind}:"]
        lines += [f"  apply_{kind}(packet, stage, memory)"]
    functions: dict[str, Any] = {"__name__": __name__, "Any": Any}
    functions |= {f"apply_{i}": one.apply for i, one in enumerate(BEHAVIOURS)}
    exec("\n".join(lines), functions)
    dispatch: Callable[..., None] = functions["dispatch"]
    return dispatch


def _compiled_modules() -> Iterator[tuple[str, str]]:
    """Yield the names and files of the modules with compiled functions."""
    for package in (noack.impairments, netem.rules, netem.engine.pump):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            spec: Any = found.module_finder.find_spec(found.name)  # type: ignore[call-arg]
            yield found.name, spec.origin
    yield histogram.__name__, str(histogram.__file__)
    spec = importlib.util.find_spec("noack.runtime.native.libc_calls")  # loads the compiler
    assert spec is not None
    yield spec.name, str(spec.origin)
