"""Files that a scenario names; relative names are relative to the scenario file.

The content of data files is read into the scenario. Files that a run executes (an FMU, a Python
source file) are not: a loaded scenario holds their absolute paths and their SHA-256, and a run
refuses a file with another SHA-256.
"""

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

from pydantic import BaseModel, Field

from noack.core.errors import CallerError
from noack.core.file_access import read_regular
from noack.settings.section import ScenarioSection

MOST_BYTES = 64 * 2**20
"""Largest size of a file that is read completely."""
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Settings = TypeVar("Settings", bound="FileSettings")
Table = TypeVar("Table", bound=BaseModel)

PLACES = ("plant.system", "trigger", "controller")
"""The tables of a scenario that may name such a file."""


class NamedFile:
    """A file, and the setting that names it; relative names are relative to ``folder``.

    Messages begin with ``place``, the table with the key ``file``, e.g. ``run.toml: network.loss``.
    """

    def __init__(self, name: str, folder: Path, place: str = "") -> None:
        self.path = folder / name
        self.named = f'{place}.file = "{name}"' if place else name

    def wrong(self, message: str) -> NoReturn:
        """Refuse the file's content by a CallerError."""
        raise CallerError(f"{self.named}: {message}")

    def content(self) -> bytes:
        """Return the file's bytes; raise CallerError if it cannot be read."""
        try:
            return read_regular(self.path, MOST_BYTES)
        except (OSError, ValueError) as error:
            self._unreadable(error)

    def lines(self) -> Iterator[tuple[int, str]]:
        """Yield the lines that are neither empty nor comments (#), with their numbers from 1."""
        text = self.content().decode("utf-8", errors="replace")
        for number, line in enumerate(text.splitlines(), 1):
            if line.strip() and not line.startswith("#"):
                yield number, line.strip()

    def sha256(self) -> str:
        """Return the SHA-256 of the file in hexadecimal; raise CallerError if it cannot be read."""
        try:
            if self.path.exists() and not self.path.is_file():
                self.wrong("cannot be read: not a regular file")
            with self.path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except (OSError, ValueError) as error:
            self._unreadable(error)

    def _unreadable(self, error: OSError | ValueError) -> NoReturn:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise CallerError(f"{self.named}: cannot be read: {reason}") from None


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
    be read without the file. Settings that name no file are returned unchanged. Raise CallerError
    if the file cannot be read; ``place`` names the table.
    """
    if settings.file is None:
        return settings
    file = NamedFile(settings.file, folder, place)
    sha256 = settings.sha256 or file.sha256()
    return settings.model_copy(update={"file": str(file.path.absolute()), "sha256": sha256})


def unchanged(settings: FileSettings, place: str) -> Path:
    """Return the path of a loaded setting's file; raise CallerError if missing or changed."""
    file = NamedFile(settings.file or "", Path(), place)
    if (found := file.sha256()) != settings.sha256:
        file.wrong(
            f"has changed: its SHA-256 is {found[:16]}..., "
            f"that of the run is {(settings.sha256 or 'not given')[:16]}..."
        )
    return file.path
