"""The estimated size of a record, and runs that do not fit on the disk."""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cosim.live.disk_space import require_disk_space
from cosim.live.launcher import launch
from cosim.simulation.virtual_time import simulate
from netem.core.errors import MachineError
from noack.scenario.resolution import ResolvedRun, resolve, resolve_run
from noack.scenario.scenario_file import validate


def with_free(monkeypatch: pytest.MonkeyPatch, free: float) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=int(free)))


def test_the_estimated_size_is_that_of_all_rows_except_events(content: dict[str, Any]) -> None:
    resolved = resolve(validate(content, ""))
    record = simulate(resolved)
    events = ("controller_delivery", "netem_packet", "netem_release")
    rows = [record[table].nbytes for table in record.tables if table not in events]
    assert ResolvedRun(resolved).step_bytes == pytest.approx(sum(rows), rel=0.002)


def test_a_run_that_cannot_fit_is_refused_and_one_that_may_not_fit_begins_with_a_warning(
    content: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    scenario = validate(content | {"horizon_s": 1e7}, "")
    with_free(monkeypatch, resolve_run(scenario).step_bytes - 1)
    with pytest.raises(MachineError, match=r"this run records .* are free on the disk"):
        launch(scenario, tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
    longer = content | {"horizon_s": 1000.0}
    resolved = resolve(validate(longer, ""))
    run = resolve_run(validate(longer | {"loops": [{"name": "one"}, {"name": "two"}]}, ""))
    for share, warned in ((1.0, True), (2.9, True), (3.0, False)):
        with_free(monkeypatch, share * 2 * ResolvedRun(resolved).step_bytes)
        require_disk_space(run.step_bytes, tmp_path / "not" / "yet")
        assert ("warning: " in capsys.readouterr().err) == warned
