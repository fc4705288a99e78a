"""Writes files atomically: completely or not at all."""

from contextlib import suppress
from pathlib import Path

from noack.core.errors import MachineError, why


def write_whole(path: Path, content: str | bytes, remedy: str = "") -> Path:
    """Write a file, or replace it, in one step; return its path. Missing folders are created.

    Text is written as UTF-8. ``remedy`` ends the error message.

    Raises:
        MachineError: the file cannot be written.
    """
    scratch = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_bytes(content.encode() if isinstance(content, str) else content)
        scratch.replace(path)
    except OSError as error:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)
        raise MachineError(f"{path}: cannot be written: {why(error)}{remedy}") from None
    return path
