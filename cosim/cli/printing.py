"""What commands print: the result as text or as JSON, tables in files, what is being done."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from netem.core.command_line import print_to_stderr
from netem.core.errors import ExitStatus
from netem.output.json_writer import print_json as print_json

if TYPE_CHECKING:
    from netem.core.console import SafeConsole
    from netem.output.document import Document
    from netem.output.result_tables import ResultTable


def console() -> "SafeConsole":
    """Return a console on standard output."""
    from netem.core.console import SafeConsole  # a program that reads JSON waits for no rich

    return SafeConsole()


def status(activity: str) -> AbstractContextManager[Callable[[str], None]]:
    """Show within the context what a command is doing; the result replaces it."""
    from cosim.live.monitoring.progress import activity as shown_activity

    return shown_activity(activity)


def show(document: "Document", *, json: bool, tables: Path | None = None, **added: object) -> None:
    """Print a document as text or, with what is added, as JSON; write the tables of ``--tables``."""
    if json:
        print_json({**document.data, **added})
    else:
        from netem.output.terminal_writer import print_document

        print_document(console(), document)
    write_tables(document.tables, tables, json=json)


def show_written(document: "Document", files: Sequence[Path], *, json: bool) -> None:
    """Print a document, and the files that were written."""
    show(document, json=json, files=[str(file) for file in files])
    if not json:
        print(*files, sep="\n")


def write_tables(tables: "Iterable[ResultTable]", folder: Path | None, *, json: bool) -> None:
    """Write the tables of ``--tables``, if it is given; print the paths, unless with ``--json``."""
    from cosim.output.table_files import save_tables

    if folder is not None:
        paths = save_tables(tables, folder)
        if not json:
            print(*paths, sep="\n")


def status_of(unmet: Iterable[str], status: int = ExitStatus.OK) -> int:
    """Print on standard error the requirements that are not met; return 1 for these, else the status.

    A command that failed has said why.
    """
    lines = list(unmet) if status == ExitStatus.OK else []
    for line in lines:
        print_to_stderr(f"noack: {line}")
    return ExitStatus.FAILED if lines else status


def print_lines(json: bool, document: object, *lines: object) -> None:
    """Print a result that is one line or few: the document of ``--json``, or the lines."""
    if json:
        print_json(document)
    else:
        print(*lines, sep="\n")
