"""A folder of credentials: made for one run, marked, and removed at the run's end.

The mark is a file in the folder. It is locked while the run is open, and it lists each written file
with its digest. A folder is replaced only if it has the mark of a run that was killed. A file is
deleted only if the mark lists it and it is as it was written.
"""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from netem.core.errors import CallerError
from netem.core.file_access import create_folder, lock, locked, move, read_regular
from netem.core.json_text import parse_json

MARK = ".noack-credentials"
_MOST_BYTES = 64 * 2**20
"""Of a file: as :mod:`noack.runtime.connections.credentials` reads."""


@contextmanager
def credentials_folder(folder: Path, files: Mapping[str, bytes]) -> Iterator[None]:
    """Write private files into a new folder, which appears in one step; remove them at the end.

    Args:
        folder: is made. A folder that the mark of a killed run is in is replaced.
        files: the content of each file, by its path in the folder: a folder and a name.

    Raises:
        CallerError: the folder exists for another reason.
        OSError: it cannot be written.
    """
    _create(folder)
    with _write(folder, files) as mark:
        try:
            yield
        finally:
            with suppress(OSError, ValueError):
                if _has_mark(folder, mark):  # else somebody moved the folder
                    _remove_written(folder)


def _create(folder: Path) -> None:
    """Create an empty folder; before, remove that of a killed run."""
    try:
        create_folder(folder, exist_ok=False, mode=0o700)
    except FileExistsError:
        _remove_abandoned(folder)
        create_folder(folder, exist_ok=False, mode=0o700)


def _remove_abandoned(folder: Path) -> None:
    """Remove the folder of a run that was killed; raise CallerError if it is anything else."""
    if folder.is_symlink() or not (folder / MARK).is_file():
        raise CallerError(
            f"{folder}: exists, and is not a folder of credentials; give another by --credentials"
        )
    with locked(folder / MARK) as is_abandoned:
        if not is_abandoned:
            raise CallerError(f"{folder}: has the credentials of an open run; give another by --credentials")
        try:
            written = _written(folder)
        except ValueError:
            raise CallerError(f"{folder / MARK}: damaged; remove the folder, or give another") from None
        parts = {path.parent for path in written}
        others = sorted({*folder.rglob("*")} - {folder / MARK, *written, *parts})
        if others:
            raise CallerError(
                f"{folder}: {others[0].relative_to(folder)} is not of `noack record`; "
                "move it, or give another folder"
            )
        _remove_written(folder)


@contextmanager
def _write(folder: Path, files: Mapping[str, bytes]) -> Iterator[IO[bytes]]:
    """Put files and their mark in the place of an empty folder; yield the mark, which is locked."""
    try:
        new = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            for name, content in files.items():
                (new / name).parent.mkdir(mode=0o700, exist_ok=True)
                with _create_private(new / name) as file:
                    file.write(content)
            mark = _create_private(new / MARK)
            mark.write(json.dumps({name: _digest(content) for name, content in files.items()}).encode())
            mark.flush()
            lock(mark)
            move(new, folder)  # fails if something has been written into the folder
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise
    except BaseException:
        with suppress(OSError):
            folder.rmdir()
        raise
    with mark:
        yield mark


def _has_mark(folder: Path, mark: IO[bytes]) -> bool:
    """Whether an open mark is the one in a folder."""
    return not folder.is_symlink() and os.path.samestat(os.fstat(mark.fileno()), (folder / MARK).lstat())


def _written(folder: Path) -> list[Path]:
    """Return the files that the mark lists and that are as they were written.

    Raise OSError or ValueError if the mark cannot be read.
    """
    digests = parse_json(read_regular(folder / MARK, _MOST_BYTES))
    if not isinstance(digests, dict):
        raise ValueError("no object")
    written = []
    for name, digest in digests.items():
        part, _, base = name.partition("/")
        path = folder / part / base
        if part in ("", ".", "..") or "/" in base or path.is_symlink() or path.parent.is_symlink():
            continue
        with suppress(OSError, ValueError):
            if _digest(read_regular(path, _MOST_BYTES)) == digest:
                written.append(path)
    return written


def _remove_written(folder: Path) -> None:
    """Delete the files that the mark lists, the mark, and the folders that are empty then."""
    written = _written(folder)
    for path in (*written, folder / MARK):
        path.unlink()
    for part in (*{path.parent for path in written}, folder):
        with suppress(OSError):  # has files of others
            part.rmdir()


def _create_private(path: Path) -> IO[bytes]:
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
