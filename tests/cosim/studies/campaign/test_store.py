"""The campaign's folder: whole chunks or none, and no other campaign's."""

import errno
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from cosim.studies.campaign import chunk_store as store_module
from cosim.studies.campaign.campaign_file import Campaign, load
from cosim.studies.campaign.campaign_grid import Point, base_of, grid
from cosim.studies.campaign.campaign_run import run_campaign
from cosim.studies.campaign.campaign_workers import alone
from cosim.studies.campaign.chunk_store import Chunk, Store, opened
from noack.core.errors import CallerError, MachineError
from tests.cosim.studies.campaign.conftest import Write

Few = tuple[Campaign, list[Point]]


def files(folder: Path) -> dict[str, int]:
    """Parquet files and when they were written."""
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*.parquet")
    }


@pytest.fixture
def full(tmp_path: Path, campaign: Few) -> Store:
    plan, points = campaign
    store = Store(tmp_path / "out", points, plan.draws, plan.chunk)
    assert run_campaign(store, alone) == 28
    return store


def test_every_chunk_has_its_draws_and_the_axes_beside_them(full: Store, campaign: Few) -> None:
    assert len(files(full.folder)) == 4 * 3
    table = pyarrow.dataset.dataset(full.folder / "runs", format="parquet").to_table()
    rows = {(r["policy"], r["beta"], r["draw"]): r for r in table.to_pylist()}
    assert len(rows) == 28 == table.num_rows
    for point in campaign[1]:
        expected = point.work.run(range(7))
        for draw in range(7):
            row = rows[point.labels["policy"], point.values["beta"], draw]
            for name in expected.dtype.names or ():
                np.testing.assert_equal(row[name], expected[draw][name])
        column = full.columns(point.number, ["cost"])["cost"]
        np.testing.assert_array_equal(column, expected["cost"])


def test_what_is_there_is_not_made_again(full: Store) -> None:
    before = files(full.folder)
    assert list(full.missing()) == []
    assert run_campaign(full, alone) == 0
    assert files(full.folder) == before


def test_a_spoilt_file_is_made_again_and_no_other(full: Store) -> None:
    before = files(full.folder)
    path = full.folder / "runs" / "point-00001" / "draws-000000003.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert list(full.missing()) == [Chunk(1, 3, 6)]
    assert run_campaign(full, alone) == 3
    assert path.read_bytes() == whole
    changed = {name for name, when in files(full.folder).items() if before[name] != when}
    assert changed == {"runs/point-00001/draws-000000003.parquet"}


def test_more_draws_keep_the_chunks_that_are_full_and_fewer_keep_all(
    full: Store, campaign: Few
) -> None:
    more = Store(full.folder, campaign[1], 10, 3)
    assert {(chunk.start, chunk.stop) for chunk in more.missing()} == {(6, 9), (9, 10)}
    run_campaign(more, alone)
    expected = campaign[1][2].work.run(range(10))["cost"]
    np.testing.assert_array_equal(more.columns(2, ["cost"])["cost"], expected)
    fewer = Store(full.folder, campaign[1], 4, 3)
    assert list(fewer.missing()) == []
    np.testing.assert_array_equal(fewer.columns(2, ["cost"])["cost"], expected[:4])


def test_a_full_disk_is_one_line_and_leaves_whole_files_only(
    tmp_path: Path, campaign: Few, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, points = campaign
    store = Store(tmp_path / "out", points, plan.draws, plan.chunk)
    write, calls = pq.write_table, []

    def fill(table: Any, path: Path, **options: Any) -> None:
        calls.append(path)
        write(table, path, **options)
        if len(calls) == 5:
            os.truncate(path, 100)
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(store_module.pq, "write_table", fill)
    with pytest.raises(MachineError) as found:
        run_campaign(store, alone)
    assert str(found.value) == (
        f"{store.folder}: cannot be written: No space left on device; 12 of 28 runs are in "
        f"{store.folder}; the same command continues the campaign"
    )
    assert sum(path.is_file() for path in (store.folder / "runs").rglob("*")) == 4
    monkeypatch.undo()
    assert run_campaign(store, alone) == 16


def changed_folder(write: Write, folder: Path, plan: dict[str, Any]) -> None:
    path = write(plan)
    campaign = load(path)
    store = Store(folder, grid(campaign, path), campaign.draws, campaign.chunk)
    with opened(campaign, base_of(campaign, path)[1], store):
        pass


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("seed", 12, "campaign.seed is 11 there, 12 here"),
        ("chunk", 4, "campaign.chunk is 3 there, 4 here"),
        ("settings", {"horizon_s": 2.0}, "campaign.settings.horizon_s is null there, 2.0 here"),
        ("metrics", {"settle": 0.1}, "campaign.metrics.settle is 0.02 there, 0.1 here"),
        (
            "axes",
            [{"name": "beta", "key": "trigger.beta", "values": [0.1]}],
            "campaign.axes is ",
        ),
    ],
)
def test_another_campaign_is_refused_in_the_same_folder(
    write: Write, plan: dict[str, Any], tmp_path: Path, key: str, value: Any, expected: str
) -> None:
    folder = tmp_path / "out"
    changed_folder(write, folder, plan)
    changed_folder(write, folder, plan)
    other = plan | {"compare": None, "figures": []} | {key: value}
    with pytest.raises(CallerError) as found:
        changed_folder(write, folder, other)
    text = str(found.value)
    assert text.startswith(f"{folder}: holds another campaign (")
    assert expected in text
    assert "\n" not in text


def test_another_scenario_is_another_campaign_and_other_figures_are_not(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    changed_folder(write, folder, plan)
    plan["axes"][1]["title"] = "threshold"
    shown = {"figures": [], "compare": None, "draws": 99, "description": "new"}
    changed_folder(write, folder, plan | shown | {"metrics": {"shown": ["cost"]}})
    scenario = tmp_path / "small.toml"
    scenario.write_text(scenario.read_text().replace("mansd = 2", "mansd = 3"))
    with pytest.raises(CallerError, match=r"scenario\.network\.mansd is 2 there, 3 here"):
        changed_folder(write, folder, plan)


def test_a_folder_in_use_and_a_folder_of_someone_else_are_refused(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    path = write(plan)
    campaign = load(path)
    base = base_of(campaign, path)[1]
    store = Store(tmp_path / "out", grid(campaign, path), campaign.draws, campaign.chunk)
    with (
        opened(campaign, base, store),
        pytest.raises(CallerError, match="another noack uses this folder"),
        opened(campaign, base, store),
    ):
        pass
    (tmp_path / "mine" / "runs").mkdir(parents=True)
    with pytest.raises(CallerError, match="holds runs"):
        changed_folder(write, tmp_path / "mine", plan)
    with pytest.raises(MachineError, match="cannot be written"):
        changed_folder(write, path, plan)  # a file, not a folder


def test_what_a_kill_left_half_written_is_swept_away(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    changed_folder(write, folder, plan)
    left = folder / "runs" / "point-00000" / ".draws-000000000.parquet.partial"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"PAR1")
    changed_folder(write, folder, plan)
    assert not left.exists()


def test_a_damaged_page_is_one_line_that_says_how_to_mend_it(full: Store) -> None:
    """Sums over what a disk has changed would be wrong in silence."""
    path = full.folder / "runs" / "point-00001" / "draws-000000003.parquet"
    whole = bytearray(path.read_bytes())
    place = whole.find(np.float64(full.columns(1, ["cost"])["cost"][3]).tobytes())
    assert place > 0
    whole[place] ^= 1
    path.write_bytes(whole)
    with pytest.raises(MachineError, match="is damaged; remove it, and the same"):
        full.columns(1, ["cost"])


def test_what_a_file_of_the_scenario_says_is_part_of_the_campaign(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "lost.txt").write_text("0 1 1\n")
    plan["settings"]["network.loss"] = {"model": "trace", "file": "lost.txt"}
    changed_folder(write, tmp_path / "out", plan)
    changed_folder(write, tmp_path / "out", plan)
    (tmp_path / "lost.txt").write_text("0 1 0\n")
    with pytest.raises(CallerError, match="holds another campaign"):
        changed_folder(write, tmp_path / "out", plan)


def test_runs_of_another_noack_are_shown_but_not_added_to(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    path, folder = write(plan), tmp_path / "out"
    campaign = load(path)
    store = Store(folder, grid(campaign, path), campaign.draws, campaign.chunk)
    base = base_of(campaign, path)[1]
    with opened(campaign, base, store):
        run_campaign(store, alone)
    manifest = json.loads((folder / "campaign.json").read_text())
    manifest["arithmetic"]["numpy"] = "1.0"
    (folder / "campaign.json").write_text(json.dumps(manifest))
    with opened(campaign, base, store):
        assert run_campaign(store, alone) == 0
    more = Store(folder, store.points, 10, campaign.chunk)
    with (
        pytest.raises(CallerError, match=r"differ from the existing ones \(numpy is 1\.0 there"),
        opened(campaign, base, more),
    ):
        pass


@pytest.mark.parametrize("text", ["[]", "{}", "nonsense", '{"arithmetic": 3}'])
def test_a_manifest_that_is_none_is_one_line(
    write: Write, plan: dict[str, Any], tmp_path: Path, text: str
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "campaign.json").write_text(text)
    with pytest.raises(CallerError, match=r"campaign\.json: not a manifest of a campaign; give"):
        changed_folder(write, tmp_path / "out", plan)


def test_more_files_than_a_folder_can_bear_are_refused(campaign: Few, tmp_path: Path) -> None:
    with pytest.raises(CallerError, match=r"would be 400,000,000 files; .* or a larger chunk"):
        Store(tmp_path, campaign[1], 100_000_000, 1)
