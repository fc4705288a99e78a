"""The user's runtime directory: files that only their owner can read."""

import os
import re
import tempfile
from pathlib import Path

from noack.errors import CallerError


def private_folder() -> Path:
    """Return where the user's private files lie; the folder need not exist yet."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    return Path(base or tempfile.gettempdir()) / f"noack-{os.getuid()}"


def require_name(name: str, what: str) -> None:
    """Check that a name is fit for a file.

    Raises:
        CallerError: it is not.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", name):
        raise CallerError(f"{what} {name!r}: use letters, digits, _ and -, at most 64")


def require_private(folder: Path) -> None:
    """Check that a folder is the user's own, and closed to others.

    Raises:
        CallerError: it is not.
    """
    status = folder.stat()
    if not folder.is_dir() or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise CallerError(f"{folder}: must be a folder of yours, closed to others (mode 700)")


def make_private(folder: Path) -> None:
    """Make a folder of the user's own, in one that exists.

    Raises:
        CallerError: it cannot be made, or is not the user's own.
    """
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise CallerError(f"{folder}: cannot be made ({error.strerror})") from None
    require_private(folder)
