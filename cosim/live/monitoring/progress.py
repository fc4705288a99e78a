"""Progress of simulations and computations on the terminal."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

from rich.console import Console
from rich.progress import (
    BarColumn,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as RichProgress

from cosim.live.monitoring.progress_lines import begin_work, note_line, until_line_s
from netem.core.command_line import print_to_stderr
from netem.core.console import SafeConsole
from noack.core.progress import Progress

_LEAST_WAIT_S = 0.1
"""Between two looks whether a line is due, of a work whose inner work prints."""
_shown: list[Event] = []
"""Of the work whose lines are printed, the innermost one last."""


def error_console() -> Console:
    """Return a console on standard error."""
    return SafeConsole(stderr=True)


@contextmanager
def _bar(
    console: Console, total: float, *columns: ProgressColumn, description: str = ""
) -> Iterator[Callable[..., None]]:
    """Show a bar while the context lasts, on a terminal only; yields what updates it."""
    head = (TextColumn("{task.description}"),) if description else ()
    disabled = not console.is_terminal
    with RichProgress(
        *head, BarColumn(), *columns, console=console, disable=disabled, transient=True
    ) as progress:
        task = progress.add_task(description, total=total, rate="")
        yield lambda **fields: progress.update(task, **fields)


def _print_line(line: str) -> None:
    note_line()
    print_to_stderr(f"noack: {line}")


@contextmanager
def _line_at_intervals(line: Callable[[], str], *, printed: bool) -> Iterator[None]:
    """Print a line whenever one is due while the context lasts, but while there is one within it."""
    has_ended = Event()

    def print_lines() -> None:
        while not has_ended.wait(max(until_line_s(), _LEAST_WAIT_S)):
            if until_line_s() <= 0 and _shown[-1:] == [has_ended]:
                _print_line(line())

    if not printed:
        yield
        return
    begin_work()
    _shown.append(has_ended)
    Thread(target=print_lines, daemon=True).start()
    try:
        yield
    finally:
        _shown.remove(has_ended)
        has_ended.set()


@contextmanager
def activity(text: str) -> Iterator[Callable[[str], None]]:
    """Show what is done and for how long, while the context lasts; yields what changes the text.

    Where there is no terminal, print it as a line at intervals.
    """
    console = error_console()
    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    with RichProgress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(text)

        def change(new_text: str) -> None:
            nonlocal text
            text = new_text
            progress.update(task, description=text)

        def line() -> str:
            return f"{text}, {time.monotonic() - began_s:.0f} s"

        began_s = time.monotonic()
        with _line_at_intervals(line, printed=not console.is_terminal):
            yield change


@contextmanager
def work_bar(description: str, *, lines: bool = False) -> Iterator[Progress]:
    """Show the completed share of some work, and for how long it has been done.

    The rest of a search may take less than its share, or more. Where there is no terminal, print both as a
    line at intervals if ``lines``.
    """
    console, share, began_s = error_console(), 0.0, time.monotonic()
    columns = TextColumn("{task.percentage:.0f} %"), TimeElapsedColumn()

    def line() -> str:
        spent_s = time.monotonic() - began_s
        if not 0 < share < 1:
            return f"{description}: {spent_s:.0f} s"
        return f"{description}: {100 * share:.0f} % after {spent_s:.0f} s"

    with (
        _bar(console, 1.0, *columns, description=description) as update,
        _line_at_intervals(line, printed=lines and not console.is_terminal),
    ):

        def show(done: float, total: float = 1.0, /) -> None:
            nonlocal share
            share = done / total
            update(completed=share)

        yield show


@contextmanager
def simulation_bar(console: Console) -> Iterator[Progress]:
    """Show the simulated time of a simulation, in seconds; where there is no terminal, at intervals."""
    column = TextColumn("{task.completed:.1f}/{task.total:g} s simulated")
    text = "simulating"

    with (
        _bar(console, 1, column) as update,
        _line_at_intervals(lambda: text, printed=not console.is_terminal),
    ):

        def show(done: float, total: float = 1.0, /) -> None:
            nonlocal text
            text = f"simulating: {done:.1f} of {total:g} s"
            update(completed=done, total=total)

        yield show


@contextmanager
def runs_bar(console: Console) -> Iterator[Progress]:
    """Show the number of completed runs, their rate and the remaining time.

    Where there is no terminal, print the number as a line at intervals.
    """
    columns = (
        TextColumn("{task.completed:,.0f}/{task.total:,.0f} runs"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    before: float | None = None
    began_s, runs = time.monotonic(), "starting"

    def line() -> str:
        return f"{runs}, {time.monotonic() - began_s:.0f} s"

    with _bar(console, 1, *columns) as show, _line_at_intervals(line, printed=not console.is_terminal):

        def update(done: float, total: float = 1.0, /) -> None:
            nonlocal before, runs
            before = done if before is None else before
            runs = f"{done:,.0f} of {total:,.0f} runs"
            spent_s = time.monotonic() - began_s
            rate = (done - before) / max(spent_s, 1e-3)
            text = f"{rate:,.0f}/s" if done > before else "starting"
            show(completed=done, total=total, rate=text)

        yield update


@contextmanager
def search_activity() -> Iterator[Callable[[str], Callable[[str, int, float], None]]]:
    """Show the state of an adversary's search as :func:`activity` does."""
    with activity("searching") as change:

        def named(aim: str) -> Callable[[str, int, float], None]:
            return lambda search, nodes, value: change(
                f"worst {aim}: {search}, {nodes:,} events, {abs(value):.6g} so far"
            )

        yield named
