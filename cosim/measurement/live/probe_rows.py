"""The raw trace of a live probe, written while it runs, so that a killed process loses nothing."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Self

from noack.core.errors import CallerError, why
from noack.core.file_access import open_growing


class ProbeRows:
    """A CSV file that grows row by row; an error while writing is logged, and ends the file.

    Args:
        path: the file, which is replaced; None: no file.
        log: takes a line for the user.

    Raises:
        CallerError: the file cannot be written.
    """

    def __init__(self, path: Path | None, log: Callable[[str], None]) -> None:
        self._path, self._log = path, log
        self._waiting: list[str] = []
        self._file: int | None = None
        if path is not None:
            try:
                self._file = open_growing(path, follow=True)
            except (OSError, ValueError) as error:
                raise CallerError(f"--save {path}: cannot be written: {why(error)}") from None

    def add(self, *values: object) -> None:
        """Add a row."""
        if self._file is not None:
            self._waiting.append(",".join(map(str, values)) + "\n")

    def flush(self) -> None:
        """Pass the added rows to the system."""
        if self._file is None or not self._waiting:
            return
        data = "".join(self._waiting).encode()
        self._waiting.clear()
        try:
            while data:
                data = data[os.write(self._file, data) :]
        except OSError as error:
            self._log(f"--save {self._path}: ends here: {why(error)}; the probe continues")
            self.close()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.flush()
        self.close()
