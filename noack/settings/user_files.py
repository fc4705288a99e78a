"""Files that a scenario names; relative names are relative to the scenario file.

The content of data files is read into the scenario. Files that a run executes (a Python source
file, a model) are not: a loaded scenario holds their absolute paths and their SHA-256, and a run
refuses a file with another SHA-256.

A user's class is in a Python source file or in an installed package. Its code runs in the process
that needs it. Plants, triggers and controllers share this module.
"""

import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, ClassVar, Self, TypeVar

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, model_validator

from netem.core.errors import NoackError, one_line
from netem.core.named_file import NamedFile
from netem.core.settings_section import ScenarioSection
from noack.core.linear_systems import Vector
from noack.settings.values import MatrixRows, Row

UserCode = Any
"""A class of the user, an object of it, or what its code returns."""
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
SectionT = TypeVar("SectionT", bound=BaseModel)

FILE_TABLES = ("plant.system", "trigger", "controller")
"""The tables of a scenario that may name such a file."""


class FileSettings(ScenarioSection):
    """Settings that may name a file that a run executes."""

    file: str | None = None
    """The file; a relative name is relative to the scenario file."""
    sha256: Sha256 | None = None
    """The file's SHA-256; filled in when the scenario is loaded."""


def file_tables(scenario: BaseModel) -> Iterator[tuple[str, FileSettings]]:
    """Return the tables of a scenario that name a file, each with its place."""
    for place in FILE_TABLES:
        table: object = scenario
        for part in place.split("."):
            table = getattr(table, part)
        if isinstance(table, FileSettings) and table.file is not None:
            yield place, table


def with_tables(section: SectionT, tables: Mapping[str, BaseModel]) -> SectionT:
    """Return a scenario or section with other tables at the given places."""
    update: dict[str, BaseModel] = {}
    for place, table in tables.items():
        part, _, inner_place = place.partition(".")
        inner: BaseModel = update.get(part, getattr(section, part))
        update[part] = with_tables(inner, {inner_place: table}) if inner_place else table
    return section.model_copy(update=update)


def with_absolute_path(settings: SectionT, folder: Path, place: str) -> SectionT:
    """Return settings with the absolute path of their file (relative to a folder), and its SHA-256.

    If a SHA-256 is already given, it is used and the file is not read: so the record of a run can
    be read without the file. Settings that name no file are returned unchanged. Raise CallerError
    if the file cannot be read; ``place`` names the table.
    """
    if not isinstance(settings, FileSettings) or settings.file is None:
        return settings
    file = NamedFile(settings.file, folder, place)
    sha256 = settings.sha256 or file.sha256()
    return settings.model_copy(update={"file": str(file.path.absolute()), "sha256": sha256})


def checked_path(settings: FileSettings, place: str) -> Path:
    """Return the path of a loaded setting's file; raise CallerError if missing or changed."""
    file = NamedFile(settings.file or "", Path(), place)
    if (actual := file.sha256()) != settings.sha256:
        file.wrong(
            f"has changed: its SHA-256 is {actual[:16]}..., "
            f"{place}.sha256 is {(settings.sha256 or 'not given')[:16]}..."
        )
    return file.path


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
    parameters: dict[str, bool | int | FiniteFloat | str | Row | MatrixRows] = Field({})
    """Passed to the class as keyword arguments, arrays as lists."""

    @model_validator(mode="after")
    def _check_file(self) -> Self:
        if self.file is None and self.sha256 is not None:
            raise ValueError("sha256: is that of a file; give file, too")
        return self


def new_instance(settings: ClassSettings, place: str) -> tuple[UserCode, str]:
    """Return an instance of the class that loaded settings name, and a description of the class.

    Raises:
        CallerError: the file has changed, or is missing; ``place`` names the table.
        Exception: anything that the user's code raises; :func:`user_code` describes it.
    """
    user_class, description = _class(settings, place)
    parameters = {key: _as_list(value) for key, value in settings.parameters.items()}
    return user_class(**parameters), description


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
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _is_ours(frame)]
    source_place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    kind = "" if isinstance(error, NoackError) else f"{type(error).__name__}: "
    return f'{place}.name = "{settings.name}": {kind}{one_line(error)}{source_place}'


def read_only(values: Vector) -> Vector:
    """Return a copy that the user's code cannot write to."""
    copy = values.copy()
    copy.flags.writeable = False
    return copy


def real_vector(title: str, value: UserCode, size: int) -> Vector:
    """Return a copy of a return value of the user's code, shape (size,).

    Raises:
        TypeError: its entries are not real numbers.
        ValueError: it has another shape.
    """
    array = np.array(value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{title} must have real numbers only")
    vector = array.astype(np.float64)
    if vector.shape != (size,):
        raise ValueError(f"{title} has shape {vector.shape}, expected ({size},)")
    return vector


def _class(settings: ClassSettings, place: str) -> tuple[UserCode, str]:
    if settings.file is not None:
        path = checked_path(settings, place)
        return _attribute(_executed(path), settings.name), f"class {settings.name} of {path.name}"
    module, colon, name = settings.name.partition(":")
    if colon:
        return _attribute(import_module(module), name), f"class {settings.name}"
    from importlib import metadata  # slow to import

    found = metadata.entry_points(group=settings.group)
    entry_points = metadata.EntryPoints(point for point in found if point.attr)  # others are of kinds
    if settings.name not in entry_points.names:
        names = ", ".join(sorted(entry_points.names)) or "none"
        raise LookupError(
            f"no installed package has an entry point of this name in the group {settings.group} "
            f"(there are: {names}); write package.module:Class, or name a file, too"
        )
    entry = entry_points[settings.name]
    version = f", {entry.dist.name} {entry.dist.version}" if entry.dist else ""
    return entry.load(), f"class {entry.value}{version}"


def _attribute(module: ModuleType, name: str) -> UserCode:
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
    return "importlib" in frame.filename or any(file.is_relative_to(_ROOT / package) for package in _PACKAGES)


def _as_list(value: object) -> object:
    return [_as_list(entry) for entry in value] if isinstance(value, tuple) else value
