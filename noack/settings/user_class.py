"""A user's class that a scenario names: its settings, and how it is loaded.

The class is in a Python source file or in an installed package. Its code runs in the process that
needs it. Plants, triggers and controllers share this module.
"""

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from noack.core.errors import NoackError, one_line
from noack.core.linear_systems import Vector
from noack.settings.matrices import Row, Rows
from noack.settings.named_file import FileSettings, unchanged

_PACKAGES = ("noack", "plant_server", "sensor_node", "controller_node", "netem", "cosim")
_ROOT = Path(__file__).parents[2]


class ClassSettings(FileSettings):
    """Settings that name a user's class."""

    group: ClassVar[str]
    """The group of entry points in which packages name such classes."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z_][\w.:-]*$")]
    """The class: package.module:Class or an entry point of the group noack.plants, noack.triggers
    or noack.controllers; or, with file, the class in it."""
    file: str | None = None
    """A Python source file with the class; a relative name is relative to the scenario file."""
    parameters: dict[str, bool | int | FiniteFloat | str | Row | Rows] = Field({})
    """Passed to the class as keyword arguments, arrays as lists."""

    @model_validator(mode="after")
    def _check_file(self) -> Self:
        if self.file is None and self.sha256 is not None:
            raise ValueError("sha256: it is of a file; give file, too")
        return self


def new_instance(settings: ClassSettings, place: str) -> tuple[Any, str]:
    """Return an instance of the class that loaded settings name, and a description of the class.

    Raises:
        CallerError: the file has changed, or is missing; ``place`` names the table.
        Exception: anything that the user's code raises; :func:`user_code` describes it.
    """
    made, description = _class(settings, place)
    parameters = {key: _as_list(value) for key, value in settings.parameters.items()}
    return made(**parameters), description


@contextmanager
def user_code(settings: ClassSettings, place: str, failure: type[NoackError]) -> Iterator[None]:
    """Turn an error of the user's code in this context into a failure; failures pass."""
    try:
        yield
    except failure:
        raise
    except (Exception, SystemExit) as error:
        raise failure(_failure_text(settings, place, error)) from None


def _failure_text(settings: ClassSettings, place: str, error: BaseException) -> str:
    """Return one line about an error in the user's code: the class, the error, the source line."""
    frames = [one for one in traceback.extract_tb(error.__traceback__) if not _is_ours(one)]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f'{place}.name = "{settings.name}": {type(error).__name__}: {one_line(error)}{where}'


def read_only(values: Vector) -> Vector:
    """Return a copy that the user's code cannot write to."""
    copy = values.copy()
    copy.flags.writeable = False
    return copy


def real_vector(what: str, value: Any, size: int) -> Vector:
    """Return a copy of a return value of the user's code, shape (size,).

    Raises:
        TypeError: its entries are not real numbers.
        ValueError: it has another shape.
    """
    given = np.array(value)
    if given.dtype.kind not in "biuf":
        raise TypeError(f"{what} is not of real numbers")
    found = given.astype(np.float64)
    if found.shape != (size,):
        raise ValueError(f"{what} has shape {found.shape}, expected ({size},)")
    return found


def _class(settings: ClassSettings, place: str) -> tuple[Any, str]:
    if settings.file is not None:
        path = unchanged(settings, place)
        return _attribute(_executed(path), settings.name), f"class {settings.name} of {path.name}"
    module, colon, name = settings.name.partition(":")
    if colon:
        return _attribute(import_module(module), name), f"class {settings.name}"
    from importlib import metadata  # slow to import

    known = metadata.entry_points(group=settings.group)
    if settings.name not in known.names:
        there = ", ".join(sorted(known.names)) or "none"
        raise LookupError(
            f"no installed package has an entry point of this name in the group {settings.group} "
            f"(there are: {there}); write package.module:Class, or name a file, too"
        )
    entry = known[settings.name]
    version = f", {entry.dist.name} {entry.dist.version}" if entry.dist else ""
    return entry.load(), f"class {entry.value}{version}"


def _attribute(module: ModuleType, name: str) -> Any:
    if not hasattr(module, name):
        raise LookupError(f"{Path(module.__file__ or module.__name__).name} has no {name}")
    return getattr(module, name)


def _executed(path: Path) -> ModuleType:
    """Execute a source file as a module; it cannot import other files of its folder."""
    module = ModuleType(f"noack_user_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses needs this entry
    exec(compile(path.read_bytes(), path, "exec"), module.__dict__)
    return module


def _is_ours(frame: traceback.FrameSummary) -> bool:
    file = Path(frame.filename)
    return "importlib" in frame.filename or any(
        file.is_relative_to(_ROOT / package) for package in _PACKAGES
    )


def _as_list(value: Any) -> Any:
    return [_as_list(one) for one in value] if isinstance(value, tuple) else value
