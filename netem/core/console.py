"""The console of all programs: it styles texts, and escapes the control characters in them."""

from collections.abc import Iterable
from typing import IO, Any, cast

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from netem.core.standard_streams import SafeStream, without_controls


class SafeConsole(Console):
    """A console for texts from anywhere.

    It ignores a broken pipe; rich would end the program, and with it the run.
    """

    def on_broken_pipe(self) -> None:
        """Ignore it."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a text, table or the like, without control characters in texts."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=without_controls(segment.text))

    @property
    def file(self) -> IO[str]:
        """The stream that is written."""
        file = cast("Any", super()).file
        return cast("IO[str]", _Styled(file)) if isinstance(file, SafeStream) else file

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file


class _Styled:
    """A safe stream that is written with colours."""

    def __init__(self, stream: SafeStream) -> None:
        self._stream, self.write = stream, stream.write_styled

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
