"""The campaign's folder: only complete chunks, and only of one campaign."""

import errno
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
import pytest

from cosim.studies.campaign.campaign_file import Campaign, load
from cosim.studies.campaign.campaign_grid import Point, base_of, grid
from cosim.studies.campaign.campaign_run import run_campaign
from cosim.studies.campaign.campaign_workers import alone
from cosim.studies.campaign.chunk_store import Chunk, Store, opened
from noack.core.errors import CallerError, MachineError
from tests.cosim.studies.campaign.conftest import Write

Few = tuple[Campaign, list[Point]]


def files(folder: Path) -> dict[str, int]:
    """Parquet files and their modification times."""
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*.parquet")
    }


@pytest.fixture
def full(tmp_path: Path, campaign: Few) -> Store:
    plan, points = campaign
    store = Store(tmp_path / "out", points, plan.draws, plan.chunk)
    assert run_campaign(store, alone) == 28
    return store


def test_every_chunk_contains_its_draws_and_their_axis_values(full: Store, campaign: Few) -> None:
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


def test_existing_chunks_are_not_computed_again(full: Store) -> None:
    before = files(full.folder)
    assert list(full.missing()) == []
    assert run_campaign(full, alone) == 0
    assert files(full.folder) == before


def test_only_a_damaged_file_is_computed_again(full: Store) -> None:
    before = files(full.folder)
    path = full.folder / "runs" / "point-00001" / "draws-000000003.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert list(full.missing()) == [Chunk(1, 3, 6)]
    assert run_campaign(full, alone) == 3
    assert path.read_bytes() == whole
    changed = {name for name, when in files(full.folder).items() if before[name] != when}
    assert changed == {"runs/point-00001/draws-000000003.parquet"}


def test_more_draws_keep_full_chunks_and_fewer_draws_keep_all(full: Store, campaign: Few) -> None:
    more = Store(full.folder, campaign[1], 10, 3)
    assert {(chunk.start, chunk.stop) for chunk in more.missing()} == {(6, 9), (9, 10)}
    run_campaign(more, alone)
    expected = campaign[1][2].work.run(range(10))["cost"]
    np.testing.assert_array_equal(more.columns(2, ["cost"])["cost"], expected)
    fewer = Store(full.folder, campaign[1], 4, 3)
    assert list(fewer.missing()) == []
    np.testing.assert_array_equal(fewer.columns(2, ["cost"])["cost"], expected[:4])


def test_a_full_disk_gives_one_line_and_leaves_complete_files_only(
    tmp_path: Path, campaign: Few, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, points = campaign
    store = Store(tmp_path / "out", points, plan.draws, plan.chunk)
    write, paths = Path.write_bytes, []

    def fill(path: Path, content: bytes) -> None:
        paths.append(path)
        write(path, content[:100] if len(paths) == 5 else content)
        if len(paths) == 5:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill)
    with pytest.raises(MachineError) as found:
        run_campaign(store, alone)
    assert str(found.value).startswith(f"{store.folder}/runs/")
    assert str(found.value).endswith(
        f".parquet: cannot be written: No space left on device; 12 of 28 runs are in "
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


def test_a_changed_scenario_makes_another_campaign_and_changed_figures_do_not(
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


def test_a_folder_in_use_or_of_other_content_is_refused(
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


def test_incomplete_files_of_a_killed_run_are_removed(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    changed_folder(write, folder, plan)
    left = folder / "runs" / "point-00000" / ".draws-000000000.parquet.partial"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"PAR1")
    changed_folder(write, folder, plan)
    assert not left.exists()


def test_a_damaged_parquet_page_gives_one_line_with_the_remedy(full: Store) -> None:
    """Sums over data that the disk has changed would be wrong without a warning."""
    path = full.folder / "runs" / "point-00001" / "draws-000000003.parquet"
    whole = bytearray(path.read_bytes())
    place = whole.find(np.float64(full.columns(1, ["cost"])["cost"][3]).tobytes())
    assert place > 0
    whole[place] ^= 1
    path.write_bytes(whole)
    with pytest.raises(MachineError, match="is damaged; remove it, and the same"):
        full.columns(1, ["cost"])


def test_files_that_the_scenario_refers_to_are_part_of_the_campaign(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "lost.txt").write_text("0 1 1\n")
    plan["settings"]["network.loss"] = {"model": "trace", "file": "lost.txt"}
    changed_folder(write, tmp_path / "out", plan)
    changed_folder(write, tmp_path / "out", plan)
    (tmp_path / "lost.txt").write_text("0 1 0\n")
    with pytest.raises(CallerError, match="holds another campaign"):
        changed_folder(write, tmp_path / "out", plan)


def test_runs_of_another_version_are_shown_but_not_extended(
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
def test_an_invalid_manifest_gives_one_line(
    write: Write, plan: dict[str, Any], tmp_path: Path, text: str
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "campaign.json").write_text(text)
    with pytest.raises(CallerError, match=r"campaign\.json: not a manifest of a campaign; give"):
        changed_folder(write, tmp_path / "out", plan)


def test_too_many_files_for_a_folder_are_refused(campaign: Few, tmp_path: Path) -> None:
    with pytest.raises(CallerError, match=r"would be 400,000,000 files; .* or a larger chunk"):
        Store(tmp_path, campaign[1], 100_000_000, 1)
