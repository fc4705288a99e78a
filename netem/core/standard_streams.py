"""Standard streams that are safe: no control characters, and no error if their reader has gone.

Texts from elsewhere (the summary of a run, names in a scenario, notes of a trace) could contain
escape sequences that act on the terminal. All that a program prints goes through these streams,
which escape control characters. Only :class:`netem.core.console.SafeConsole` writes its colours.
"""

import io
import sys
import unicodedata
from typing import TYPE_CHECKING, TextIO

from netem.core.errors import printable

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_LAYOUT = "\n\t"
"""Control characters that lay out a text."""


def guard_streams(*, ignore_broken_pipes: bool = True, escape: bool = True) -> None:
    """Replace the standard streams.

    Args:
        ignore_broken_pipes: discard output to a stream after its reader has closed it. Hence `noack
            run ... | head -1` runs to its end, with the run's exit status.
        escape: escape control characters, such as those of colours.
    """
    sys.stdout, sys.stderr = (
        guarded_stream(stream, ignore_broken_pipes=ignore_broken_pipes, escape=escape)
        for stream in (sys.stdout, sys.stderr)
    )


def guarded_stream(stream: TextIO, *, ignore_broken_pipes: bool = True, escape: bool = True) -> TextIO:
    """Return a standard stream as :func:`guard_streams` says."""
    if not isinstance(stream, io.TextIOWrapper):  # the shell closed it by >&-
        return stream
    file = _OneErrorFile(stream.fileno(), "w", closefd=False)
    file.ignores_broken_pipes = ignore_broken_pipes
    return (SafeStream if escape else io.TextIOWrapper)(
        io.BufferedWriter(file),
        encoding=stream.encoding,
        errors="replace",  # a terminal that cannot show ‖x‖ gets ?x?
        # PYTHONUNBUFFERED requests more than lines; readers wait for lines.
        line_buffering=stream.line_buffering or stream.write_through,
    )


def without_controls(text: str) -> str:
    r"""Return a text with control characters escaped (``\x1b``), except line breaks and tabs."""
    if text.isprintable():
        return text
    return "".join(map(_without_control, text))


def _without_control(character: str) -> str:
    is_shown = character in _LAYOUT or unicodedata.category(character) == "Zs"  # a space of any width
    return character if is_shown else printable(character)


class SafeStream(io.TextIOWrapper):
    """A text stream that escapes control characters in what it is given."""

    def write(self, text: str, /) -> int:
        """Write text without control characters."""
        super().write(without_controls(text))
        return len(text)

    def write_styled(self, text: str) -> int:
        """Write text with the colours of a console, whose foreign parts are escaped already."""
        return super().write(text)


class _OneErrorFile(io.FileIO):
    """Raises one error if the disk is full or the reader has gone; what is written later is discarded."""

    ignores_broken_pipes = True
    _has_raised = False

    def write(self, data: "ReadableBuffer", /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            is_ignored = self.ignores_broken_pipes and isinstance(error, BrokenPipeError)
            if not self._has_raised and not is_ignored:
                self._has_raised = True
                raise
            return memoryview(data).nbytes
