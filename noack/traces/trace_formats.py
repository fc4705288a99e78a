"""Formats of packet traces, one module of this folder each, and the traces that come with noack.

:func:`read_trace` finds the format of a file.
"""

import gzip
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import IO, Any

from noack.core.errors import CallerError, one_line, shortened, why
from noack.core.file_access import open_regular
from noack.traces.packet_trace import MAX_PACKETS, PacketTrace

_HEAD_BYTES = 4096
_GZIP = b"\x1f\x8b"
_FOLDER = Path(__file__).parent / "shipped"
_LONGEST = 100


@dataclass(frozen=True)
class TraceFormat:
    """A format of files; a module of this folder adds it by defining one."""

    name: str
    """For messages, e.g. ``CSV``."""
    recognises: Callable[[bytes], bool]
    """Whether a file that begins with these bytes has the format."""
    read: Callable[[IO[bytes], int, bool], PacketTrace]
    """Reads a file, given the most packets, and whether the clocks differ.

    Raises:
        ValueError: one line without the file's name: where, what is wrong, what would be right.
    """


def _formats() -> Sequence[TraceFormat]:
    entries = iter_modules(import_module(__package__).__path__, f"{__package__}.")
    modules = (vars(import_module(entry.name)) for entry in entries if entry.name != __name__)
    return [value for module in modules for value in module.values() if isinstance(value, TraceFormat)]


def read_trace(
    path: Path,
    *,
    place: str = "",
    clocks_differ: bool = False,
    most_packets: int = MAX_PACKETS,
    others: Sequence[str] = (),
) -> PacketTrace:
    """Return the trace in a file.

    Args:
        path: the file.
        place: what messages begin with; by default the path.
        clocks_differ: see :func:`noack.traces.packet_trace.packet_trace`.
        most_packets: most packets of the trace.
        others: what the caller reads besides; for a message.

    Raises:
        CallerError: one line; the file cannot be read, or is not a trace.
    """
    known = _formats()
    try:
        with open_regular(path) as file:
            head, file = _decompressed(file)
            known_format = next((candidate for candidate in known if candidate.recognises(head)), None)
            if known_format is None:
                names = ", ".join(sorted(candidate.name for candidate in known))
                raise ValueError(
                    f"not a packet trace; {names} can be read, also compressed by gzip"
                    f"{''.join(f', {other}' for other in others)}; a CSV file "
                    "begins with a header, e.g. sequence,sent_ms,received_ms"
                )
            return known_format.read(file, most_packets, clocks_differ)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise CallerError(f"{place or path}: cannot be decompressed: {one_line(error)}") from None
    except (OSError, ValueError) as error:
        reason = f"cannot be read: {why(error)}" if isinstance(error, OSError) else one_line(error)
        raise CallerError(f"{place or path}: {reason}") from None


def _decompressed(file: IO[bytes]) -> tuple[bytes, IO[bytes]]:
    """Return how a file begins, and the file from its beginning, decompressed if necessary."""
    head = file.read(_HEAD_BYTES)
    file.seek(0)
    if not head.startswith(_GZIP):
        return head, file
    content: Any = gzip.GzipFile(fileobj=file)
    head = content.read(_HEAD_BYTES)
    content.seek(0)
    return head, content


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
    shipped = {path.stem: path for path in _FOLDER.glob("*/*.csv")}
    if name in shipped:
        return shipped[name]
    raise CallerError(
        f"{named or shortened(name)}: no such file, nor a shipped trace; "
        f"there are {', '.join(sorted(shipped))}"
    )
