"""The terminal's progress line."""

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from cosim.live.monitoring.run_terminal import RunTerminal
from noack.runtime.control_messages import RunProgress
from tests.helpers.shipped import resolved


@pytest.mark.parametrize("terminal", [True, False])
def test_the_terminal_reports_each_cause_once(terminal: bool) -> None:
    output = io.StringIO()
    report: dict[str, Any] = {
        "t_s": 0.5, "events": 3, "deliveries": 2, "longest_loss_burst": 1, "x_norm": 1.0,
        "live": None,
    }  # fmt: skip
    console = Console(file=output, force_terminal=terminal, width=200)
    with RunTerminal(resolved("lane_following"), console) as terminal_line:
        terminal_line.started(Path())
        for void in ([], ["one [cause]"], ["one [cause]"], ["one [cause]", "another"]):
            terminal_line.progress(RunProgress(**report, warnings=void))
    assert output.getvalue().count("one [cause]") == 1
    assert output.getvalue().count("another") == 1


def test_no_completed_record_is_promised_when_a_run_ends_early() -> None:
    """On a full disk, the record of the run cannot be completed."""
    output = io.StringIO()
    RunTerminal(resolved("lane_following"), Console(file=output)).stopping("recorder: the disk is full")
    assert output.getvalue() == "recorder: the disk is full; the run ends\n"
