"""The terminal follows a run: a progress bar, and lines about what happens."""

import math
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Self

from cosim.live.coordination.remote_access import ListenSettings
from cosim.live.monitoring.progress_lines import begin_work, note_line, until_line_s
from cosim.live.monitoring.run_observers import RunObserver
from netem.core.address import address_text
from noack.runtime.control_messages import RunProgress
from noack.scenario.scenario import Scenario, loop_names

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID


_PLAIN_LINES = 10
"""Progress lines of a run on a terminal that cannot redraw a line."""


class RunTerminal(RunObserver):
    """Shows a run on standard error, or on another console, until the context ends.

    rich is imported when there is something to show: the start of the run does not wait for it.
    """

    def __init__(self, scenario: Scenario, console: "Console | None" = None) -> None:
        self._scenario, self._given_console = scenario, console
        self._task: TaskID | None = None
        self._plain_lines = 0
        self._lines: dict[str, int] = {}
        """How many lines of a list have been shown, by field."""

    def __enter__(self) -> Self:
        begin_work()
        return self

    def __exit__(self, *_: object) -> None:
        if self._task is not None:
            self._bar.stop()

    def waiting(self, roles: Sequence[str]) -> None:
        """Name the processes that the start barrier waits for."""
        if roles:
            self._print(f"waiting for {', '.join(roles)}")

    def listening(self, settings: ListenSettings) -> None:
        """Say how processes on other hosts join."""
        address, folder = address_text(settings.address), settings.folder
        self._print(
            f"listening on {address}; copy the credentials of each role to the host where it runs, and "
            "start it there; they are secret:\n"
            f"  scp -r {folder / 'sensor'} HOST:\n"
            "  noack sensor --credentials sensor"
        )

    def started(self, run_dir: Path) -> None:
        """Begin the bar."""
        self._bar.start()
        self._task = self._bar.add_task(self._scenario.name, total=self._scenario.horizon_s)

    def progress(self, report: RunProgress) -> None:
        """Show the recorder's progress report."""
        self._print_new("live", [report.live] if report.live else [])
        self._print_new("warnings", report.warnings, style="yellow")
        self._print_new("changes", [f"changed: {change}" for change in report.changes])
        text = progress_text(report, self._scenario.horizon_s, len(loop_names(self._scenario)))
        if self._task is not None:
            self._bar.update(self._task, completed=report.t_s, description=text)
        due = math.floor(report.t_s / self._scenario.horizon_s * _PLAIN_LINES)
        if self._console.is_dumb_terminal and due > self._plain_lines:
            self._plain_lines = due
            self._print(text)
        if not self._console.is_terminal and until_line_s() <= 0:
            note_line()
            self._print(f"noack: {text}")

    def stopping(self, why: str) -> None:
        """Say why the run ends early."""
        self._print(f"{why}; the run ends")

    def notice(self, line: str) -> None:
        """Show a line about the run."""
        self._print(line)

    @cached_property
    def _console(self) -> "Console":
        from cosim.live.monitoring.progress import error_console  # imports rich

        return self._given_console or error_console()

    @cached_property
    def _bar(self) -> "Progress":
        from rich.progress import BarColumn, Progress, TextColumn  # takes 0.1 s

        can_redraw = self._console.is_terminal and not self._console.is_dumb_terminal
        columns = (BarColumn(bar_width=12), TextColumn("{task.description}"))
        return Progress(*columns, console=self._console, disable=not can_redraw)

    def _print_new(self, field: str, texts: Sequence[str], style: str = "") -> None:
        for text in texts[self._lines.get(field, 0) :]:
            self._print(text, style)
        self._lines[field] = max(self._lines.get(field, 0), len(texts))

    def _print(self, line: str, style: str = "") -> None:
        self._console.print(line, style=style, markup=False, highlight=False, soft_wrap=True)


def progress_text(report: RunProgress, horizon_s: float, loops: int = 1) -> str:
    """The recorder's progress report as one line; ``loops`` is the number of loops."""
    norm = "-" if report.x_norm is None else f"{report.x_norm:.3g}"
    of_loops = f"{loops} loops  " if loops > 1 else ""
    return (
        f"{report.t_s:.1f}/{horizon_s:g} s  {of_loops}events {report.events}  "
        f"delivered {report.deliveries}  longest loss burst {report.longest_loss_burst}  "
        f"late by up to {report.late_us / 1e3:.2g} ms  ‖x‖ {norm}"
    )
