"""Files that a scenario names and a run executes: an FMU, a Python source file.

Their content is not read into the scenario. A loaded scenario holds their absolute paths and their
SHA-256; a run refuses a file with another SHA-256.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field

from noack.settings.named_file import NamedFile
from noack.settings.section import ScenarioSection

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Settings = TypeVar("Settings", bound="FileSettings")
Table = TypeVar("Table", bound=BaseModel)

PLACES = ("plant.system", "trigger", "controller")
"""The tables of a scenario that may name such a file."""


class FileSettings(ScenarioSection):
    """Settings that may name a file that a run executes."""

    file: str | None = None
    """The file; a relative name is relative to the scenario file."""
    sha256: Sha256 | None = None
    """The file's SHA-256; filled in when the scenario is loaded."""


def file_tables(scenario: BaseModel) -> Iterator[tuple[str, FileSettings]]:
    """Return the tables of a scenario that name a file, each with its place."""
    for place in PLACES:
        table: Any = scenario
        for part in place.split("."):
            table = getattr(table, part)
        if isinstance(table, FileSettings) and table.file is not None:
            yield place, table


def with_tables(section: Table, tables: Mapping[str, BaseModel]) -> Table:
    """Return a scenario or section with other tables at the given places."""
    update: dict[str, BaseModel] = {}
    for place, table in tables.items():
        part, _, rest = place.partition(".")
        inner: BaseModel = update.get(part, getattr(section, part))
        update[part] = with_tables(inner, {rest: table}) if rest else table
    return section.model_copy(update=update)


def located(settings: Settings, folder: Path, place: str) -> Settings:
    """Return settings with the absolute path of their file (relative to a folder), and its SHA-256.

    If a SHA-256 is already given, it is used and the file is not read: so the record of a run can
    be read without the file. Settings that name no file are returned unchanged.

    Raises:
        CallerError: the file does not exist, or cannot be read; ``place`` names the table.
    """
    if settings.file is None:
        return settings
    file = NamedFile(settings.file, folder, place)
    sha256 = settings.sha256 or file.sha256()
    return settings.model_copy(update={"file": str(file.path.absolute()), "sha256": sha256})


def unchanged(settings: FileSettings, place: str) -> Path:
    """Return the path of the file that loaded settings name.

    Raises:
        CallerError: the file is missing, or has changed since the scenario was loaded.
    """
    file = NamedFile(settings.file or "", Path(), place)
    if (found := file.sha256()) != settings.sha256:
        file.wrong(
            f"has changed: its SHA-256 is {found[:16]}..., "
            f"that of the run is {(settings.sha256 or 'not given')[:16]}..."
        )
    return file.path
