"""What long work prints where there is no terminal."""

import re
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import pytest

from cosim.live.monitoring import progress, progress_lines

MOST_S = 60.0


@pytest.mark.parametrize(
    "work",
    [
        (lambda: progress.work_bar("proving", lines=True), "proving"),
        (lambda: progress.activity("proving"), "proving"),
        (lambda: progress.runs_bar(progress.error_console()), "starting"),
        (lambda: progress.simulation_bar(progress.error_console()), "simulating"),
    ],
    ids=["work_bar", "activity", "runs_bar", "simulation_bar"],
)
def test_long_work_is_not_silent_though_it_reports_nothing(
    work: tuple[Callable[[], AbstractContextManager[object]], str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(progress_lines, "LINE_EVERY_S", 0.01)
    printed, ends_s = "", time.monotonic() + MOST_S
    begin, text = work
    with begin():
        while "\n" not in printed and time.monotonic() < ends_s:
            time.sleep(0.01)
            printed += capsys.readouterr().err
    assert printed.startswith(f"noack: {text}")


def test_the_first_line_of_a_command_is_due_earlier(monkeypatch: pytest.MonkeyPatch) -> None:
    """The imports before the command's start count for who waits, too."""
    monkeypatch.setattr(progress_lines, "LINE_EVERY_S", 2000.0)
    monkeypatch.setattr(progress_lines, "FIRST_LINE_S", 1000.0)
    with progress_lines.lines_of_command():
        assert 0 < progress_lines.until_line_s() <= 1000.0
        progress_lines.note_line()
        assert 1000.0 < progress_lines.until_line_s() <= 2000.0


@pytest.mark.parametrize("is_command", [True, False])
def test_short_works_of_a_command_that_follow_each_other_are_not_silent_for_long(
    is_command: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last line was long ago when this work begins; in other programs this does not count."""
    monkeypatch.setattr(progress_lines, "LINE_EVERY_S", 1000.0)
    with progress_lines.lines_of_command() if is_command else nullcontext():
        monkeypatch.setattr(progress_lines, "_last_s", time.monotonic() - 1000.0)
        printed, ends_s = "", time.monotonic() + (MOST_S if is_command else 0.5)
        with progress.activity("checking"):
            while "\n" not in printed and time.monotonic() < ends_s:
                time.sleep(0.01)
                printed += capsys.readouterr().err
            time.sleep(0.3)
            printed += capsys.readouterr().err
    assert printed.count("\n") == is_command


def test_the_share_is_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress_lines, "LINE_EVERY_S", 0.01)
    printed, ends_s = "", time.monotonic() + MOST_S
    with progress.work_bar("proving", lines=True) as show:
        show(1.0, 4.0)
        while not re.search(r"25 % .*\n", printed) and time.monotonic() < ends_s:
            time.sleep(0.01)
            printed += capsys.readouterr().err
    assert re.search(r"noack: proving: 25 % after \d+ s\n", printed)


def test_work_within_other_work_prints_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress_lines, "LINE_EVERY_S", 0.01)
    printed, ends_s = "", time.monotonic() + MOST_S
    with progress.activity("outer"), progress.work_bar("inner", lines=True):
        capsys.readouterr()
        while printed.count("\n") < 3 and time.monotonic() < ends_s:
            time.sleep(0.01)
            printed += capsys.readouterr().err
    assert "inner" in printed
    assert printed.count("outer") <= 1  # begun before
