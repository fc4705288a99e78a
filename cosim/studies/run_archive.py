"""An archive of a run: one ZIP file with everything that its repetition needs.

The entries are stored, not compressed: the record is compressed already, so that the same run gives
the same bytes, and no entry is larger than the file. ``archive.json``, the first entry, has the
size and the SHA-256 of every other one.
"""

import hashlib
import os
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cosim.live.finalize import reopen
from cosim.record.run_directory import (
    ENDING_FILE,
    ENVIRONMENT_FILE,
    RECORD,
    REPORTS_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    Kind,
    kind_of,
)
from noack.config.scenario import Scenario, loops_of
from noack.config.scenario_file import MOST_RECORDED_BYTES, load
from noack.core.errors import CallerError, MachineError, one_line, printable, why
from noack.core.file_access import new_file, open_regular
from noack.settings.user_files import PLACES, Sha256, file_tables

MANIFEST = "archive.json"
SUFFIX = ".noack.zip"
_FILES = {
    SCENARIO_FILE, ENVIRONMENT_FILE, REPORTS_FILE, ENDING_FILE, SUMMARY_FILE
}  # fmt: skip
_FOLDERS = {RECORD, "logs", *(place.split(".")[0] for place in PLACES)}
_MOST_ENTRIES = 1_000_000
_MOST_MANIFEST_BYTES = 256 * 2**20
_CHUNK_BYTES = 2**20
_PART = re.compile(r"[^\x00-\x1f\x7f/\\:]{1,255}")
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time that ZIP has


class Entry(BaseModel):
    """Size and checksum of a file of an archive."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    bytes: Annotated[int, Field(ge=0)]
    sha256: Sha256


class Manifest(BaseModel):
    """The content of ``archive.json``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    format: Literal["noack run archive 2"] = "noack run archive 2"
    scenario: str
    kind: Kind
    files: dict[str, Entry]


def write_archive(run_dir: Path, path: Path) -> Manifest:
    """Write the archive of a run, which is finalised first if necessary.

    Raises:
        CallerError: it is not a run directory, the run is active, or its scenario names files
            elsewhere.
        MachineError: a file cannot be read, or the archive cannot be written.
    """
    reopen(run_dir)
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    if (outside := outside_files(scenario, run_dir)) is not None:
        raise CallerError(f"{run_dir}: its scenario names {outside}, outside the run directory")
    try:
        names = sorted(_names(run_dir))
        files = {name: _entry(run_dir / name) for name in names}
        manifest = Manifest(scenario=scenario.name, kind=kind_of(run_dir), files=files)
        with new_file(path) as target, zipfile.ZipFile(target, "w") as archive:
            content = manifest.model_dump_json(indent=1).encode()
            archive.writestr(_info(MANIFEST, len(content)), content)
            for name, entry in files.items():
                with open_regular(run_dir / name) as source:
                    _copy_in(source, archive, _info(name, entry.bytes))
    except (OSError, ValueError) as error:
        reason = why(error) if isinstance(error, OSError) else str(error)
        raise MachineError(f"{path}: the archive cannot be written: {reason}") from None
    return manifest


def unpack(path: Path, folder: Path) -> Manifest:
    """Check an archive, and write its files into a folder, which is empty.

    Raises:
        CallerError: the file is not such an archive, is damaged, or names files elsewhere.
        MachineError: the folder cannot be written.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            infos = _checked_entries(path, archive, os.fstat(file.fileno()).st_size)
            manifest = _manifest(path, archive)
            if missing := sorted(manifest.files.keys() ^ (infos.keys() - {MANIFEST})):
                raise CallerError(
                    f"{path}: {MANIFEST} and the archive do not have the same files, e.g. "
                    f"{printable(missing[0])}"
                )
            for name, entry in manifest.files.items():
                _copy_out(archive, infos[name], folder / name, entry, f"{path}: {name}")
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, ValueError) as error:
        raise CallerError(f"{path}: not an archive of a run: {one_line(error)}") from None
    except OSError as error:
        place = f"{path}: " if error.filename in (None, str(path)) else f"{folder}: "
        kind = CallerError if place.startswith(f"{path}:") else MachineError
        raise kind(f"{place}{why(error)}") from None
    return manifest


def outside_files(scenario: Scenario, folder: Path) -> str | None:
    """Return a file that a scenario names outside a folder; None if there is none."""
    for one in (scenario, *loops_of(scenario)):
        for _, table in file_tables(one):
            if not Path(table.file or "").resolve().is_relative_to(folder.resolve()):
                return table.file
    return None


def _names(folder: Path) -> Iterator[str]:
    """Yield the files of a run directory that an archive has, as POSIX paths relative to it."""
    for path in folder.iterdir():
        if path.name in _FILES:
            yield path.name
        elif path.name in _FOLDERS and path.is_dir():
            yield from (f"{path.name}/{inner.name}" for inner in path.iterdir() if inner.is_file())


def _entry(path: Path) -> Entry:
    with open_regular(path) as file:
        digest = hashlib.file_digest(file, "sha256")  # type: ignore[arg-type]
        return Entry(bytes=file.tell(), sha256=digest.hexdigest())


def _info(name: str, size: int) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, _EPOCH)
    info.create_system, info.external_attr, info.file_size = 3, 0o644 << 16, size
    return info


def _copy_in(source: IO[bytes], archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> None:
    with archive.open(info, "w") as target:
        while chunk := source.read(_CHUNK_BYTES):
            target.write(chunk)


def _checked_entries(
    path: Path, archive: zipfile.ZipFile, most_bytes: int
) -> dict[str, zipfile.ZipInfo]:
    """Return the entries by name; refuse what no archive of noack's has."""
    infos = archive.infolist()
    if len(infos) > _MOST_ENTRIES:
        raise CallerError(f"{path}: has {len(infos):,} entries, more than an archive may have")
    found: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name, shown = info.filename, printable(info.filename)
        parts = name.split("/")
        if not all(_PART.fullmatch(part) and part not in (".", "..") for part in parts):
            raise CallerError(f"{path}: {shown}: not the name of a file in a run directory")
        if name != MANIFEST and not (
            (len(parts) == 1 and parts[0] in _FILES) or (len(parts) == 2 and parts[0] in _FOLDERS)
        ):
            raise CallerError(f"{path}: {shown}: an archive has no such file")
        if name in found:
            raise CallerError(f"{path}: {shown}: is there twice")
        if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
            raise CallerError(f"{path}: {shown}: is compressed; noack's archives are not")
        found[name] = info
    if sum(info.file_size for info in infos) > most_bytes:
        raise CallerError(f"{path}: its entries overlap")
    if MANIFEST not in found:
        raise CallerError(f"{path}: not an archive of a run: has no {MANIFEST}")
    return found


def _manifest(path: Path, archive: zipfile.ZipFile) -> Manifest:
    if archive.getinfo(MANIFEST).file_size > _MOST_MANIFEST_BYTES:
        raise CallerError(f"{path}: {MANIFEST} is too large")
    try:
        return Manifest.model_validate_json(archive.read(MANIFEST))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "content"
        raise CallerError(f"{path}: {MANIFEST}: {printable(place)}: {first['msg']}") from None


def _copy_out(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path, entry: Entry, what: str
) -> None:
    """Write an entry, and check its size and its SHA-256."""
    digest, size = hashlib.sha256(), 0
    target.parent.mkdir(parents=True, exist_ok=True)
    with archive.open(info) as source, target.open("xb") as file:
        while chunk := source.read(_CHUNK_BYTES):
            digest.update(chunk)
            size += len(chunk)
            file.write(chunk)
    if (size, digest.hexdigest()) != (entry.bytes, entry.sha256):
        raise CallerError(f"{printable(what)}: is damaged: its SHA-256 is not that of {MANIFEST}")
