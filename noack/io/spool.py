"""The spool: batches of the record on disk as they arrive, readable up to the last whole one.

One file per table and writer, a sequence of chunks ``first row (u64), bytes (u64), rows``, little
endian. A killed writer leaves at most one broken chunk at the end, which readers ignore. The same
rows may come twice, from two writers; row numbers tell.
"""

import errno
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from noack.errors import MachineError

_CHUNK = struct.Struct("<QQ")


class SpoolWriter:
    """Appends batches to the spool.

    Args:
        folder: the spool's directory; it is created.
        writer: names this writer's files.
    """

    def __init__(self, folder: Path, writer: str) -> None:
        self._folder = folder
        self._writer = writer
        self._files: dict[str, BinaryIO] = {}
        folder.mkdir(parents=True, exist_ok=True)

    def append(self, table: str, first: int, payload: bytes) -> None:
        """Write one batch through to the operating system.

        Raises:
            MachineError: the disk is full or the folder cannot be written.
        """
        try:
            file = self._files.get(table)
            if file is None:
                path = self._folder / f"{table}.{self._writer}"
                file = self._files[table] = path.open("ab", buffering=0)
            chunk = _CHUNK.pack(first, len(payload)) + payload
            written = file.write(chunk)
            if written != len(chunk):  # what a full disk leaves must not be read as rows later
                file.truncate(file.tell() - written)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise MachineError(f"{self._folder}: the record cannot be written: {error}") from None

    def close(self) -> None:
        """Close all files."""
        for file in self._files.values():
            file.close()
        self._files.clear()


def read_chunks(folder: Path, table: str) -> Iterator[tuple[int, bytes]]:
    """Yield ``(first row, rows)`` of every whole batch of a table, of all writers."""
    for path in sorted(folder.glob(f"{table}.*")):
        size = path.stat().st_size
        with path.open("rb") as file:
            while len(head := file.read(_CHUNK.size)) == _CHUNK.size:
                first, length = _CHUNK.unpack(head)
                if file.tell() + length > size:
                    break
                yield first, file.read(length)
