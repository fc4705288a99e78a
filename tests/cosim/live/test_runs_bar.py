"""The number of completed runs, where there is no terminal."""

import io

import pytest

from cosim.live import progress
from cosim.live.progress import PipeSafeConsole, runs_bar


def test_a_pipe_gets_a_line_at_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, output = 100.0, io.StringIO()
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s)
    with runs_bar(PipeSafeConsole(file=output)) as update:
        update(0, 1200)
        for done in range(1, 9):  # a run every second and a half
            now_s += 1.5
            update(done, 1200)
    assert output.getvalue().splitlines() == [
        "noack: 4 of 1,200 runs after 6 s", "noack: 8 of 1,200 runs after 12 s",
    ]  # fmt: skip
