"""What a run shows where there is no terminal."""

import io

import pytest
from rich.console import Console

from cosim.live.monitoring import progress_lines, run_terminal
from noack.runtime.control_messages import RunProgress
from tests.helpers.shipped import shipped


@pytest.mark.parametrize(("every_s", "lines"), [(0.0, 2), (1e9, 0)])
def test_a_long_run_prints_lines_without_a_terminal(
    monkeypatch: pytest.MonkeyPatch, every_s: float, lines: int
) -> None:
    monkeypatch.setattr(progress_lines, "LINE_EVERY_S", every_s)
    output = io.StringIO()
    terminal = run_terminal.RunTerminal(shipped("lane_following"), Console(file=output, width=500))
    for t_s in (1.0, 2.0):
        terminal.progress(
            RunProgress(t_s=t_s, events=1, deliveries=1, longest_loss_burst=0, x_norm=1.0, live=None)
        )
    assert output.getvalue().count("noack: ") == lines
    assert ("2.0/20 s" in output.getvalue()) is (lines > 0)
