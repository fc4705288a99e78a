"""How a run ended, stored in its directory as soon as the run ends.

The file is created blank when the run begins. This reserves its space on the disk, so the reason
can be stored even if the disk is full or no longer writable.
"""

import contextlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from cosim.record.run_directory import ENDING_FILE
from noack.core.errors import ExitStatus, MachineError, NoackError, why
from noack.core.file_access import open_growing

_RESERVED_BYTES = 4096


@dataclass(frozen=True)
class RunEnding:
    """How a run ended."""

    run_dir: Path
    run_id: int
    status: ExitStatus
    reason: str
    startup_s: float | None = None
    """Wall time from the launch to simulated time 0; None if unknown."""


class EndingFile:
    """The file in which a run's launcher stores how the run ends.

    As a context manager it stores the error that leaves the context, unless an end is stored.

    Raises:
        MachineError: the file cannot be written.
    """

    def __init__(self, run_dir: Path) -> None:
        self._is_blank = True
        try:
            self._file = os.fdopen(open_growing(run_dir / ENDING_FILE), "wb", buffering=0)
            self._file.write(b" " * _RESERVED_BYTES)
        except OSError as error:
            raise MachineError(f"{run_dir}: the run cannot be written: {why(error)}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        if self._is_blank and isinstance(error, NoackError):
            self.store(error.exit_status, str(error))
        self._file.close()

    def store(self, status: ExitStatus, reason: str, startup_s: float | None = None) -> None:
        """Store how the run ended, under the keys of its summary."""
        self._is_blank = False
        found = {"exit": {"status": int(status), "reason": reason}, "startup_s": startup_s}
        text = json.dumps(found).encode().ljust(_RESERVED_BYTES)
        with contextlib.suppress(OSError):  # the terminal also shows the ending
            self._file.seek(0)
            self._file.write(text)
            self._file.truncate()
