"""The spool: batches of the record on disk as they arrive, readable up to the last complete one.

One file per table and writer: a sequence of batches ``first row (u64), bytes (u64), rows``, little
endian. A killed writer leaves at most one incomplete batch at the end, which readers ignore. Two
writers may write the same rows; the row numbers identify them. A table of a run's log has lines of
text, each a JSON object, in place of rows.
"""

import contextlib
import hashlib
import os
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, BinaryIO, NamedTuple

from netem.core.errors import MachineError, why
from netem.core.file_access import create_folder, open_append

SPOOL = "spool"  # the spool's folder in the run directory
KEPT_REPORT = "report"
"""Name of a process's final report in the spool, in place of a table's."""
_BATCH_HEAD = struct.Struct("<QQ")
"""Number of a batch's first row, and bytes of its rows."""
_READ_BYTES = 256 * 1024
NOTICES = "notices"
_NEWLINE = b"\n"


def writer_of(secret: str) -> str:
    """Return the name of a process, which names its files: only the process knows the secret."""
    return hashlib.sha256(secret.encode()).hexdigest()[:32]


class SpoolWriter:
    """Appends batches to files in ``folder``, which is created in the run directory.

    The files are named after the ``writer``. The methods raise MachineError if the disk is full or
    a file cannot be written.
    """

    def __init__(self, folder: Path, writer: str) -> None:
        self._folder = folder
        self._writer = writer
        self._files: dict[str, BinaryIO] = {}
        with self._errors_with_path():
            create_folder(folder)

    def append(self, table: str, first: int, payload: bytes) -> None:
        """Write one batch through to the operating system."""
        with self._errors_with_path():
            _write_complete(self._open(table), _BATCH_HEAD.pack(first, len(payload)) + payload)

    def prepare(self, tables: Iterable[str]) -> None:
        """Open the files of tables before the first rows."""
        with self._errors_with_path():
            for table in tables:
                self._open(table)

    @contextlib.contextmanager
    def _errors_with_path(self) -> Iterator[None]:
        """Turn a system error into one with the folder and the reason."""
        try:
            yield
        except OSError as error:
            raise MachineError(f"{self._folder}: the record cannot be written: {why(error)}") from None

    def require_present(self) -> None:
        """Raise MachineError if a file was deleted or moved: rows in deleted files are lost."""
        for table, file in self._files.items():
            path = self._path(table)
            try:
                present = os.path.samestat(os.fstat(file.fileno()), path.stat())
            except FileNotFoundError:
                present = False
            if not present:
                raise MachineError(f"{path}: was deleted or moved during the run")

    def _path(self, table: str) -> Path:
        return self._folder / f"{table}.{self._writer}"

    def _open(self, table: str) -> BinaryIO:
        if (file := self._files.get(table)) is None:
            file = os.fdopen(open_append(self._path(table)), "ab", buffering=0)
            self._files[table] = file
        return file

    def close(self) -> None:
        """Close all files."""
        for file in self._files.values():
            file.close()
        self._files.clear()


def _write_complete(file: BinaryIO, batch: bytes) -> None:
    """Write a complete batch or nothing: a partial batch would be read as rows later."""
    written = 0
    try:
        while written < len(batch):
            written += file.write(batch[written:])
    except OSError:
        file.truncate(file.tell() - written)
        raise


class SpoolBatch(NamedTuple):
    """One batch in a file of the spool."""

    first: int
    """Number of its first row."""
    rows: bytes


def spool_files(folder: Path, table: str) -> list[Path]:
    """Return the files of a table, one per writer."""
    return sorted(folder.glob(f"{table}.*"))


def batches_in(data: memoryview) -> tuple[list[tuple[int, memoryview]], int]:
    """Return the complete batches at the beginning of data, and their length.

    Of each batch: the number of its first row, and the rows.
    """
    batches, begin, rows = [], 0, _BATCH_HEAD.size
    while rows <= len(data):
        first, length = _BATCH_HEAD.unpack_from(data, begin)
        if (end := rows + length) > len(data):
            break
        batches.append((first, data[rows:end]))
        begin, rows = end, end + _BATCH_HEAD.size
    return batches, begin


def batch_bytes(data: memoryview) -> int | None:
    """Return the length of the batch that begins with some data; None if they are too short."""
    return None if len(data) < _BATCH_HEAD.size else _BATCH_HEAD.size + int(_BATCH_HEAD.unpack_from(data)[1])


def batches_of_file(file: IO[bytes]) -> Iterator[SpoolBatch]:
    """Yield the complete batches of an open file, from its beginning."""
    size, end = os.fstat(file.fileno()).st_size, 0
    file.seek(0)
    while len(head := file.read(_BATCH_HEAD.size)) == _BATCH_HEAD.size:
        first, length = _BATCH_HEAD.unpack(head)
        end += _BATCH_HEAD.size + length
        if end > size:  # incomplete, or damaged: a read could be endless
            break
        yield SpoolBatch(first, file.read(length))


def read_batches(folder: Path, table: str) -> Iterator[SpoolBatch]:
    """Yield each complete batch of a table, from all writers."""
    for path in spool_files(folder, table):
        with path.open("rb", buffering=_READ_BYTES) as file:
            yield from batches_of_file(file)


def notices_of(role: str) -> str:
    """Name of a process's log lines in the spool."""
    return f"{NOTICES}_{role}"


def batch_of(lines: Iterable[bytes]) -> bytes:
    """Return a batch of lines, each a JSON object without line breaks."""
    return _NEWLINE.join(lines)


def lines_in(batch: bytes) -> list[bytes]:
    """Return the lines of a batch."""
    return batch.split(_NEWLINE)


def stored_lines(spool: Path, role: str) -> Iterator[bytes]:
    """Yield the log lines of a process in a spool; a line may come twice."""
    for _, batch in read_batches(spool, notices_of(role)):
        yield from lines_in(batch)
