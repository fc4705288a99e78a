"""What a process on another host keeps of a run because it cannot send it: one file.

The first line says of which process it is. Then each part has a line with its table, the number of
its first row and its length in bytes, and then the rows. Lines are JSON. The secret in the first line
shows that the file is of this process: the run knows the process by the secret's digest.
"""

import os
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import IO, Annotated

from pydantic import Field

from netem.core.errors import CallerError, MachineError, PeerError, why
from netem.core.file_access import create_file, open_append, open_regular
from noack.runtime.control_messages import ControlMessage, Count, message_json, parse_message
from noack.runtime.spool import KEPT_REPORT, NOTICES, notices_of
from noack.runtime.telemetry import first_row

_MOST_LINE_BYTES = 4096
_MOST_PART_BYTES = 64 * 2**20
"""A process keeps no more in memory before it writes a part."""


class KeptHead(ControlMessage):
    """First line of a file of kept rows."""

    run: str  # name of the run
    process: str
    secret: str


class KeptPart(ControlMessage):
    """Line before some rows of a table; of lines of the log and of the final report, too."""

    table: str
    first: Count
    bytes: Annotated[int, Field(ge=0, le=_MOST_PART_BYTES)]


class KeptFile:
    """The file of a process; it is made with the first rows, ``ROLE.spool`` in a folder.

    Another run may have kept a file there: then the name of this run is in the name, too.
    """

    def __init__(self, folder: Path, head: KeptHead) -> None:
        self._folder, self._head = folder, head

    @cached_property
    def path(self) -> Path:
        """The path of the file, which is made now; raise MachineError if that is impossible."""
        role = self._head.process
        for path in (self._folder / f"{role}.spool", self._folder / f"{role}-{self._head.run}.spool"):
            try:
                descriptor = create_file(path, 0o600)
            except FileExistsError:
                continue
            except OSError as error:
                raise MachineError(f"{path}: rows cannot be kept: {why(error)}") from None
            os.close(descriptor)
            self._write(path, message_json(self._head.fields()) + b"\n")
            return path
        raise MachineError(f"{path}: rows cannot be kept: the file exists")

    def append(self, table: str, header: bytes, payload: bytes) -> None:
        """Write a batch; raise MachineError if it cannot be written."""
        name = notices_of(self._head.process) if table == NOTICES else table
        self._append(name, first_row(header), payload)

    def keep_report(self, report: Mapping[str, object]) -> None:
        """Write the final report; raise MachineError if it cannot be written."""
        self._append(KEPT_REPORT, 0, message_json({**report, "process": self._head.process}))

    def _append(self, table: str, first: int, content: bytes) -> None:
        line = message_json({"table": table, "first": first, "bytes": len(content)})
        self._write(self.path, line + b"\n" + content)

    @staticmethod
    def _write(path: Path, data: bytes) -> None:
        try:
            with os.fdopen(open_append(path), "ab") as file:
                file.write(data)
        except OSError as error:
            raise MachineError(f"{path}: rows cannot be kept: {why(error)}") from None


def read_kept(path: Path) -> tuple[KeptHead, Iterator[tuple[KeptPart, bytes]]]:
    """Return the first line of a file of kept rows, and its complete parts.

    Raise CallerError if it cannot be read, PeerError if it is no such file.
    """
    try:
        with open_regular(path) as file:
            head = parse_message(KeptHead, file.readline(_MOST_LINE_BYTES))
    except (OSError, ValueError) as error:
        raise CallerError(f"{path}: cannot be read: {why(error)}") from None
    except PeerError:
        raise PeerError(f"{path}: not a file of rows that a process kept") from None
    return head, _parts(path)


def _parts(path: Path) -> Iterator[tuple[KeptPart, bytes]]:
    with open_regular(path) as file:
        file.readline(_MOST_LINE_BYTES)
        while (line := file.readline(_MOST_LINE_BYTES)).endswith(b"\n"):
            try:
                part = parse_message(KeptPart, line)
            except PeerError as error:
                raise PeerError(f"{path}: damaged: {error}") from None
            if len(content := _read(file, part.bytes)) < part.bytes:
                return  # the process was killed while it wrote
            yield part, content


def _read(file: IO[bytes], count: int) -> bytes:
    return file.read(count) if count else b""
