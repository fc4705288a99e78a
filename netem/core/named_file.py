"""A data file that a setting names; a relative name is relative to the folder of the settings file."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from netem.core.errors import CallerError
from netem.core.file_access import read_regular

MOST_BYTES = 64 * 2**20
"""Largest size of a file that is read completely."""


class NamedFile:
    """A file, and the setting that names it; relative names are relative to ``folder``.

    Messages begin with ``place``, the table with the key ``file``, e.g. ``run.toml: network.loss``.
    """

    def __init__(self, name: str, folder: Path, place: str = "") -> None:
        self.name, self.folder, self.path = name, folder, folder / name
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
