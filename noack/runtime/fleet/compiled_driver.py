"""The driver of a role's fleet as compiled code, from the user's cache."""

import importlib.util
import inspect
from functools import cache
from pathlib import Path
from typing import Any

from noack.config.fleet_layout import FleetRole
from noack.core.code_cache import CALLED_BY_CODE, cache_folder
from noack.runtime.fleet.wire_words import compute_tag
from noack.runtime.native.object_code import NativeFunction, code_file, load, load_or_compile

_MODULES = (
    "noack.core.ordered_arithmetic", "noack.core.model_arrays", "noack.trigger.trigger_arrays",
    "noack.config.fleet_layout", "noack.runtime.fleet.wire_words",
    "noack.runtime.fleet.deadline_heap", "noack.runtime.native.libc_calls",
    "noack.runtime.fleet.fleet_driver", "noack.runtime.fleet.replay_driver",
)  # fmt: skip
_SOURCES = (
    "noack.runtime.native.object_code", "noack.runtime.native.socket_structs", __name__,
    "noack.runtime.fleet.driver_layout", "noack.protocol.datagram_seal",
    "noack.protocol.wire_format",
)  # fmt: skip
_OPTIONS: dict[str, Any] = {**CALLED_BY_CODE, "_nrt": False, "forceinline": True}
_CALLED: dict[str, Any] = {**CALLED_BY_CODE, "_nrt": False}
"""For a function that is long and called at two places."""


@cache
def kept_driver(role: FleetRole, what: str = "drive") -> NativeFunction | None:
    """Return the driver if it has been compiled on this machine, else None; or the replay."""
    file = _file(role, what)
    return None if file is None else load(file)


def kept_replay(role: FleetRole) -> NativeFunction | None:
    """Return the replay if it has been compiled on this machine, else None."""
    return kept_driver(role, "replay")


def compiled_driver(role: FleetRole, arguments: tuple[Any, ...]) -> NativeFunction:
    """Return the driver; compile it if that has not happened on this machine.

    ``arguments`` are those of a call; their types do not depend on the scenario.
    """
    if (kept := kept_driver(role)) is not None:
        return kept
    machine, inline = _registered(role)
    from noack.runtime.fleet.fleet_driver import driver_of

    driver = driver_of(machine.handle, machine.on_timer, inline)
    return load_or_compile(_file(role), driver, lambda: (*arguments, 0))


def compiled_replay(role: FleetRole, arguments: tuple[Any, ...]) -> NativeFunction:
    """Return the replay of a role; compile it if that has not happened on this machine."""
    if (kept := kept_replay(role)) is not None:
        return kept
    machine, _ = _registered(role)
    from noack.runtime.fleet.replay_driver import replay_driver_of

    replay = replay_driver_of(machine.handle, machine.on_timer)
    return load_or_compile(_file(role, "replay"), replay, lambda: (*arguments, 0))


def _registered(role: FleetRole) -> tuple[Any, Any]:
    """Let the compiler know all functions; return the role's module and what adds a function."""
    from numba.extending import register_jitable

    for name in (*_MODULES, role.module):
        module = importlib.import_module(name)
        for _, function in inspect.getmembers(module, inspect.isfunction):
            if function.__module__ == name:
                options = _CALLED if function is compute_tag else _OPTIONS
                register_jitable(**options)(function)
    return importlib.import_module(role.module), register_jitable(**_OPTIONS)


def _file(role: FleetRole, what: str = "drive") -> Path | None:
    found = [importlib.util.find_spec(name) for name in (*_MODULES, *_SOURCES, role.module)]
    folder = cache_folder("fleet", [Path(str(spec and spec.origin)) for spec in found])
    return None if folder is None else code_file(folder, f"{role.module}-{what}")
