"""Lines of a run's log, published and stored in batches: text with one JSON object a line."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from noack.protocol.machine_interface import GENERATION
from noack.runtime.spool import read_chunks

NOTICES = "notices"
_NEWLINE = b"\n"


def notices_of(role: str) -> str:
    """Name of a process's log lines in the spool."""
    return f"{NOTICES}_{role}"


def notice_number(generation: int, first: int) -> int:
    """Number of a process's log line in the spool; it contains the generation."""
    return generation * GENERATION + first


def batch_of(lines: Iterable[bytes]) -> bytes:
    """Return a batch of lines, each a JSON object without line breaks."""
    return _NEWLINE.join(lines)


def lines_in(batch: bytes) -> list[bytes]:
    """Return the lines of a batch."""
    return batch.split(_NEWLINE)


def stored_lines(spool: Path, role: str) -> Iterator[bytes]:
    """Yield the log lines of a process in a spool; a line may come twice."""
    for _, batch in read_chunks(spool, notices_of(role)):
        yield from lines_in(batch)
