"""The pump's functions, compiled once for this machine."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from netem.engine.compiled_rules import compile_rule, is_kept
from netem.engine.pump.client_table import insert, remove
from netem.engine.pump.pump_loop import run_pump
from netem.rules.settings_change import carry

_SOURCES: Any = (run_pump, insert, remove, carry)


class Functions(NamedTuple):
    """The functions that Python calls."""

    run_pump: Callable[..., int]
    insert: Callable[..., None]
    remove: Callable[..., None]
    carry: Callable[..., None]


@cache
def functions() -> Functions:
    """Return the functions; each is compiled or loaded at its first call."""
    return Functions(*map(compile_rule, _SOURCES))


def are_kept() -> bool:
    """Whether compiled code of all functions is in the cache, for this machine."""
    return all(map(is_kept, _SOURCES))
