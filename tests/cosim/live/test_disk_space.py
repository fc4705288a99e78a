import shutil
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from cosim.live.launcher import launch, require_disk_space, spool_bytes
from cosim.simulation.virtual_time import simulate
from noack.core.errors import MachineError
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate


class Usage(NamedTuple):
    free: int


def scenario_of(content: dict[str, Any], horizon_s: float = 1.0) -> Scenario:
    return validate(content | {"horizon_s": horizon_s}, "here")


def with_free(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: Usage(free))


def test_the_estimated_size_is_that_of_all_rows_except_events(content: dict[str, Any]) -> None:
    resolved = resolve(scenario_of(content))
    record = simulate(resolved)
    events = ("controller_delivery", "netem_packet", "netem_release")
    rows = [record[table].nbytes for table in record.tables if table not in events]
    assert spool_bytes(resolved) == pytest.approx(sum(rows), rel=0.002)


def test_a_run_that_cannot_fit_is_refused(
    content: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = scenario_of(content, 1e7)
    with_free(monkeypatch, spool_bytes(resolve(scenario)) - 1)
    with pytest.raises(MachineError, match=r"this run records .* are free on the disk"):
        launch(scenario, tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_a_run_that_may_not_fit_begins_with_a_warning(
    content: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    resolved = resolve(scenario_of(content, 1000.0))
    for share, warned in ((1.0, True), (2.9, True), (3.0, False)):
        with_free(monkeypatch, int(share * 2 * spool_bytes(resolved)))
        require_disk_space([resolved] * 2, tmp_path / "not" / "yet")
        assert ("warning: " in capsys.readouterr().err) == warned
