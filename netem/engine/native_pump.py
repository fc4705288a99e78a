"""The pump as compiled code, from the user's cache."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from netem.engine.compiled_rules import folder, prepare
from netem.engine.pump_memory import PumpMemory
from noack.core.core_library import dtype_of
from noack.runtime.native.object_code import NativeFunction, code_file, load, load_or_compile

_NAME = "run_pump"
NOT_COMPILED = (
    "noack netem: relays by plain Python, which delays each datagram longer; "
    "`noack netem --compile` prepares the compiled emulator once for the next runs"
)
"""The line for a run before which the pump has not been compiled: compiling takes too long."""


@cache
def kept_pump() -> NativeFunction | None:
    """Return the pump if it has been compiled on this machine, else None."""
    file = _file()
    return None if file is None else load(file)


@cache
def compiled_pump() -> NativeFunction:
    """Return the pump; compile it if that has not happened on this machine."""
    from netem.engine.pump.pump_loop import run_pump

    prepare()
    return load_or_compile(_file(), run_pump, _examples)


def _file() -> Path | None:
    kept = folder()
    return None if kept is None else code_file(kept, _NAME)


def _examples() -> tuple[Any, ...]:
    """Return arguments of the pump; only their types matter."""
    return PumpMemory(1, segment=False, taps=0).memory, np.zeros(1, dtype_of("noack_decision")), 0
