"""Packet traces that come with noack, found by name."""

from pathlib import Path

from noack.core.errors import CallerError, shortened

_FOLDER = Path(__file__).parent / "shipped"
_LONGEST = 100


def find_trace(name: str, folder: Path = Path(), named: str = "") -> Path:
    """Return the path of a trace given by path, or by the name of a shipped one.

    Args:
        name: as the user gave it.
        folder: a relative path is relative to it.
        named: what a message calls the name; by default the name.

    Raises:
        CallerError: a bare name that is neither that of a file nor that of a shipped trace.
    """
    path = folder / name
    if len(Path(name).parts) != 1 or Path(name).suffix or len(name) > _LONGEST or path.exists():
        return path
    shipped = {one.stem: one for one in _FOLDER.glob("*/*.csv")}
    if name in shipped:
        return shipped[name]
    raise CallerError(
        f"{named or shortened(name)}: no such file, nor a shipped trace; "
        f"there are {', '.join(sorted(shipped))}"
    )
