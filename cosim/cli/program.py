"""The program: error messages, closed standard streams, help."""

import io
import sys
from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any, TextIO

import typer
from typer.core import TyperGroup, TyperOption

from noack.core.errors import ExitStatus, printable, why
from noack.runtime.command_line import failed

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer
    from typer._click.core import Command, Context, Parameter
    from typer._click.formatting import HelpFormatter

NAME = "noack"
_COMPLETION = ("install_completion", "show_completion")


class Program(TyperGroup):
    """All commands; a usage error is printed as one line with a suggestion."""

    _words: Sequence[str] = ()

    def get_params(self, ctx: "Context") -> list["Parameter"]:
        """Return the options before the command; the help hides those of shell completion.

        If the command comes first, none is needed: for their values typer would import pydantic,
        which takes 0.1 s.
        """
        if self._words and not self._words[0].startswith("-"):
            return []
        found = super().get_params(ctx)
        for parameter in found:
            if isinstance(parameter, TyperOption) and parameter.name in _COMPLETION:
                parameter.hidden = True
        return found

    def format_commands(self, ctx: "Context", formatter: "HelpFormatter") -> None:
        """Write the commands, a section for each panel."""
        by_panel = groupby(
            self.commands.values(), lambda command: getattr(command, "rich_help_panel", "")
        )
        for panel, some in by_panel:
            with formatter.section(panel):
                formatter.write_dl(
                    [(command.name or "", command.get_short_help_str(200)) for command in some]
                )

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Run the program; the arguments are those of :class:`typer.core.TyperGroup`."""
        words = self._words = list(sys.argv[1:] if args is None else args)
        try:
            status = super().main(
                words or ["--help"], prog_name, complete_var, False, windows_expand_args, **extra
            )
            status = status if words else ExitStatus.CALLER
        except typer.TyperException as error:
            status = ExitStatus.CALLER
            if message := self._line(error, words):
                failed(message, status, who=NAME, as_json="--json" in words)
        except OSError as error:  # help is written to a full disk
            text, as_json = f"cannot write: {why(error)}", "--json" in words
            status = failed(text, ExitStatus.FAILED, who=NAME, as_json=as_json)
        if standalone_mode:
            sys.exit(int(status or 0))
        return status

    def _line(self, error: typer.TyperException, words: Sequence[str]) -> str:
        """Return the usage error as one line; empty if the help has been shown."""
        message = printable(" ".join(error.format_message().split())).rstrip(".")
        if not message:
            return ""
        message = message[0].lower() + message[1:].replace("Input should", "should")
        message = message.replace("Value error, ", "")
        name = next((word for word in words if word in self.commands), None)
        where, command = (f"{name}: ", f"{NAME} {name}") if name else ("", NAME)
        if near := getattr(error, "possibilities", None):
            return f"{where}no such option: {error.option_name}; did you mean {near[0]}?"  # type: ignore[attr-defined]
        if message.endswith("?"):
            return f"{where}{message}"
        if name and message.startswith("missing "):
            return f"{where}{message}, e.g. `{examples_of(self.commands[name])[0]}`"
        return f"{where}{message}; see `{command} --help`"


def examples_of(command: "Command") -> list[str]:
    """Return the commands of the examples at the end of a help page."""
    lines = (command.epilog or "").splitlines()
    commands = (line.strip().partition("   ")[0] for line in lines)
    return [line for line in commands if line.startswith(f"{NAME} ")]


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
