"""The pump's functions, compiled once for this machine."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from netem.engine.compiled import compile_rule, is_kept, keeps
from netem.engine.pump.clients import insert, remove
from netem.engine.pump.pump import run_pump
from netem.rules.change import carry
from netem.say import say
from noack.io.code_cache import while_compiling


class Functions(NamedTuple):
    """What Python calls."""

    run_pump: Callable[..., int]
    insert: Callable[..., None]
    remove: Callable[..., None]
    carry: Callable[..., None]


@cache
def functions() -> Functions:
    """Return them; say so if they have to be compiled, which takes a while."""
    sources: Any = (run_pump, insert, remove, carry)
    if not all(map(is_kept, sources)):
        say(while_compiling("the relay", keeps()))
    return Functions(*map(compile_rule, sources))
