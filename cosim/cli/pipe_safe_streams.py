"""Standard streams that discard what their reader no longer reads."""

import io
import sys
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


def ignore_broken_pipes() -> None:
    """Discard output to a standard stream after its reader has closed it.

    Hence `noack run ... | head -1` runs to its end, with the run's exit status.
    """
    sys.stdout, sys.stderr = pipe_safe_stream(sys.stdout), pipe_safe_stream(sys.stderr)


def pipe_safe_stream(stream: TextIO) -> TextIO:
    """Return a standard stream that discards output after its reader has closed it."""
    if not isinstance(stream, io.TextIOWrapper):  # the shell closed it by >&-
        return stream
    return io.TextIOWrapper(
        io.BufferedWriter(_PipeSafeFile(stream.fileno(), "w", closefd=False)),
        encoding=stream.encoding,
        errors="replace",  # a terminal that cannot show ‖x‖ gets ?x?
        # PYTHONUNBUFFERED requests more than lines; readers wait for lines.
        line_buffering=stream.line_buffering or stream.write_through,
    )


class _PipeSafeFile(io.FileIO):
    """Raises one error if the disk is full; the rest, written at the end, is discarded."""

    _full = False

    def write(self, data: "ReadableBuffer", /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if not self._full and not isinstance(error, BrokenPipeError):
                self._full = True
                raise
            return memoryview(data).nbytes
