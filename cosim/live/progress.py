"""The progress line that a person sees during a run."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from cosim.live.launcher import Watcher
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.runtime.join_ticket import DEFAULT_SESSION

_PLAIN_LINES = 10
"""Progress lines of a run whose terminal cannot redraw one."""


class PatientConsole(Console):
    """A console whose reader may leave: rich would end the program, and with it the run."""

    def on_broken_pipe(self) -> None:
        """Go on in silence."""


@contextmanager
def progress_line(
    console: Console, scenario: Scenario, session: str | None = None
) -> Iterator[Watcher]:
    """Show a run's progress while the context lasts."""
    live = console.is_terminal and not console.is_dumb_terminal
    there = "" if session in (None, DEFAULT_SESSION) else f" --session {session}"
    columns = (BarColumn(bar_width=12), TextColumn("{task.description}"))
    shown = 0
    live_told, void_told, changes_told = False, 0, 0
    with Progress(*columns, console=console, disable=not live, transient=False) as progress:
        task: TaskID | None = None

        def waiting(roles: Sequence[str]) -> None:
            if roles:
                console.print(f"waiting for {', '.join(roles)}")

        def started(run_dir: Path) -> None:
            nonlocal task
            task = progress.add_task(scenario.name, total=scenario.horizon_s)

        def lost(why: str, t_s: float, by_hand: str | None) -> None:
            remedy = (
                "another is started"
                if by_hand is None
                else f"start it again: noack {by_hand}{there}"
            )
            console.print(
                f"{why} at {t_s:.1f} s; the run goes on, {remedy}", highlight=False, soft_wrap=True
            )

        def back(role: str, t_s: float) -> None:
            console.print(f"{role} is back at {t_s:.1f} s", highlight=False)

        def account(account: dict[str, Any]) -> None:
            nonlocal shown, live_told, void_told, changes_told
            if account["live"] and not live_told:
                live_told = True
                console.print(account["live"], highlight=False, soft_wrap=True)
            why = account.get("void", [])
            for text in why[void_told:]:
                console.print(f"[yellow]{escape(text)}[/]", highlight=False, soft_wrap=True)
            void_told = max(void_told, len(why))
            changes = account.get("changes", [])
            for text in changes[changes_told:]:
                console.print(f"changed: {text}", markup=False, highlight=False, soft_wrap=True)
            changes_told = max(changes_told, len(changes))
            text = account_line(account, scenario.horizon_s)
            if task is not None:
                progress.update(task, completed=account["t_s"], description=text)
            due = math.floor(account["t_s"] / scenario.horizon_s * _PLAIN_LINES)
            if console.is_dumb_terminal and due > shown:
                shown = due
                console.print(text, highlight=False, soft_wrap=True)

        yield Watcher(waiting, started, lost, back, account)


@contextmanager
def work_bar(what: str) -> Iterator[Callable[[float], None]]:
    """Show which share of some work is done while the context lasts, on a terminal only."""
    console = PatientConsole(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn())
    disabled = not console.is_terminal
    with Progress(*columns, console=console, disable=disabled, transient=True) as progress:
        task = progress.add_task(what, total=1.0)
        yield lambda share: progress.update(task, completed=share)


@contextmanager
def simulation_bar(console: Console, horizon_s: float) -> Iterator[Callable[[int], None]]:
    """Show how far a simulation is while the context lasts, on a terminal only."""
    columns = (BarColumn(), TextColumn("{task.completed:.1f}/{task.total:g} s simulated"))
    disabled = not console.is_terminal
    with Progress(*columns, console=console, disable=disabled, transient=True) as progress:
        task = progress.add_task("", total=horizon_s)
        yield lambda now_ns: progress.update(task, completed=now_ns / NS_PER_S)


@contextmanager
def draws_bar(console: Console) -> Iterator[Callable[[int, int], None]]:
    """Show how many draws of how many are done while the context lasts, on a terminal only."""
    columns = (BarColumn(), TextColumn("{task.completed:g}/{task.total:g} draws"))
    disabled = not console.is_terminal
    with Progress(*columns, console=console, disable=disabled, transient=True) as progress:
        task = progress.add_task("", total=1)
        yield lambda done, total: progress.update(task, completed=done, total=total)


@contextmanager
def runs_bar(console: Console) -> Iterator[Callable[[int, int], None]]:
    """Show how many runs of how many there are, and until when, on a terminal only."""
    columns = (
        BarColumn(),
        TextColumn("{task.completed:,.0f}/{task.total:,.0f} runs"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    disabled = not console.is_terminal
    began_s, before = time.monotonic(), -1
    with Progress(*columns, console=console, disable=disabled, transient=True) as progress:
        task = progress.add_task("", total=1, rate="")

        def update(done: int, total: int) -> None:
            nonlocal before
            before = done if before < 0 else before
            rate = (done - before) / max(time.monotonic() - began_s, 1e-3)
            text = f"{rate:,.0f}/s" if done > before else "starting; the first time it compiles"
            progress.update(task, completed=done, total=total, rate=text)

        yield update


@contextmanager
def search_status() -> Iterator[Callable[[str], Callable[[str, int, float], None]]]:
    """Show how a search goes while the context lasts, on a terminal only."""
    began_s = time.monotonic()
    with PatientConsole(stderr=True).status("searching") as status:

        def named(aim: str) -> Callable[[str, int, float], None]:
            def report(what: str, nodes: int, value: float) -> None:
                elapsed_s = time.monotonic() - began_s
                status.update(
                    f"{aim}, {what}: {nodes} segments, worst {abs(value):.6g}, {elapsed_s:.0f} s"
                )

            return report

        yield named


def account_line(account: Mapping[str, Any], horizon_s: float) -> str:
    """The recorder's account of a run under way, as a line."""
    norm = "-" if account["x_norm"] is None else f"{account['x_norm']:.3g}"
    return (
        f"{account['t_s']:.1f}/{horizon_s:g} s  events {account['events']}  "
        f"delivered {account['deliveries']}  longest drop run {account['longest_loss_burst']}  "
        f"‖x‖ {norm}"
    )
