"""Where the parts of noack come from: the modules of its own folders, and of installed packages.

A part is a kind of plant, controller, trigger or disturbance, a format of exports, a command, or who
follows runs. An installed package, an extension, names its modules as entry points of a group, e.g.

    [project.entry-points."noack.plants"]
    swing = "noack_swing.plant"

:func:`parts` reads both alike. ``docs/extending.md`` shows a complete extension.
"""

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout, suppress
from functools import cache
from importlib import import_module, metadata
from pkgutil import iter_modules
from types import ModuleType
from typing import TypeVar

from netem.core.errors import printable

Part = TypeVar("Part")

NO_EXTENSIONS = "NOACK_NO_EXTENSIONS"
"""Environment variable: if it is set, installed extensions are ignored."""
_WARNED_OF = "NOACK_WARNED_OF_EXTENSIONS"
"""Environment variable: the packages of which this process, or one that started it, has warned."""
WITH_CLASSES = frozenset({"noack.plants", "noack.controllers", "noack.triggers"})
"""Groups in which an entry point ``module:Class`` names a user's class, for ``kind = "python"``."""
KNOWN: Mapping[str, Mapping[str, str]] = {
    "noack.plants": {"fmu": "noack-fmi", "gymnasium": "noack-gymnasium", "ros2": "noack-ros2"},
    "noack.controllers": {"ros2": "noack-ros2"},
    "noack.exports": {"mcap": "noack-ros2"},
    "noack.commands": {"bridge": "noack-ros2", "lab": "noack-lab"},
    "noack.scenarios": dict.fromkeys(("cart_pole_mujoco", "double_pendulum_mujoco"), "noack-gymnasium"),
}
"""The extensions that come with noack, by group and name of a part: to say what is to be installed."""


def parts(package: str | None, group: str, read: Callable[[ModuleType], Part | None]) -> Iterator[Part]:
    """Yield what ``read`` returns of each module: of a package of noack, then of extensions.

    A module of an extension that cannot be imported, or of which ``read`` raises an exception or
    returns None, is left out, with one line of warning for its package. Of noack's own modules those
    are left out of which ``read`` returns None. Subpackages are not searched.

    Args:
        package: the package of noack; None if noack itself has no such part.
        group: the group of entry points; empty if extensions have no such part.
        read: returns the part that a module defines, or None.
    """
    path = import_module(package).__path__ if package is not None else ()
    for entry in iter_modules(path, f"{package}."):
        if not entry.ispkg and (part := read(import_module(entry.name))) is not None:
            yield part
    for point in _entry_points() if group else ():
        if point.group != group:
            continue
        try:
            if group in WITH_CLASSES and point.attr:
                continue
            with redirect_stdout(sys.stderr):  # what it prints is no part of a command's output
                part = read(point.load())
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # an extension's code can raise any error
            _warn(_package(point), f"{point.value}: {_first_line(error)}")
            continue
        if part is None:
            _warn(_package(point), f"{point.value}: it has nothing for the group {group}")
        else:
            yield part


def missing_extension(group: str, name: str) -> str | None:
    """Return how a part is installed that an extension of noack has; None if none has it."""
    package = KNOWN.get(group, {}).get(name)
    return package and f"needs an extension that is not installed; pip install {package}"


@cache
def _entry_points() -> tuple[metadata.EntryPoint, ...]:
    """Return the entry points of extensions, by package and name.

    Only packages that have such groups are parsed: ``metadata.entry_points`` takes twice the time.
    """
    found: dict[str, metadata.EntryPoints] = {}  # of a package that is installed twice, the first
    if os.environ.get(NO_EXTENSIONS):
        return ()
    for package in metadata.distributions():
        try:
            if "[noack." in (package.read_text("entry_points.txt") or ""):
                found.setdefault(package.name, package.entry_points)
        except Exception as error:  # of a damaged installation of any package
            _warn(_folder(package), _first_line(error))
    return tuple(
        point for name in sorted(found) for point in sorted(found[name]) if point.group.startswith("noack.")
    )


def _package(point: metadata.EntryPoint) -> str:
    return point.dist.name if point.dist else point.value


def _folder(package: metadata.Distribution) -> str:
    """Return where a package is installed, of which the description cannot be read."""
    return str(getattr(package, "_path", package))  # it may have no name


def _first_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}"


def _warn(package: str, reason: str) -> None:
    """Print a warning of a package, unless this process or one that started it has done so."""
    warned_of = os.environ.get(_WARNED_OF, "").split("\n")
    if package not in warned_of and sys.stderr is not None:
        os.environ[_WARNED_OF] = "\n".join(filter(None, (*warned_of, package)))
        with suppress(OSError, ValueError):  # full or broken pipe; closed
            line = printable(f"a part of the extension {package} is ignored: {reason}")
            print(f"noack: warning: {line}", file=sys.stderr, flush=True)
