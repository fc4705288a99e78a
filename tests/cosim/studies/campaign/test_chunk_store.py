"""The campaign's folder: only complete chunks, and only of one campaign."""

import errno
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow.dataset
import pytest

from cosim.studies.campaign.campaign_grid import base_of
from cosim.studies.campaign.campaign_workers import run_in_process
from cosim.studies.campaign.chunk_store import Chunk, Store, locked_folder, run_campaign
from netem.core import file_access
from netem.core.errors import CallerError, MachineError
from tests.cosim.studies.campaign.conftest import Few, Write, few_of
from tests.helpers.campaign_files import files


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


def test_only_a_damaged_file_is_computed_again(full: Store) -> None:
    before = files(full.folder)
    assert list(full.missing()) == []
    assert run_campaign(full, run_in_process) == 0
    assert files(full.folder) == before
    path = full.folder / "runs" / "point-00001" / "draws-000000003.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert list(full.missing()) == [Chunk(1, 3, 6)]
    assert run_campaign(full, run_in_process) == 3
    assert path.read_bytes() == whole
    changed_files = {name for name, time in files(full.folder).items() if before[name] != time}
    assert changed_files == {"runs/point-00001/draws-000000003.parquet"}


def test_more_draws_keep_full_chunks_and_fewer_draws_keep_all(full: Store, campaign: Few) -> None:
    larger_store = Store(full.folder, campaign[1], 10, 3)
    assert {(chunk.start, chunk.stop) for chunk in larger_store.missing()} == {(6, 9), (9, 10)}
    run_campaign(larger_store, run_in_process)
    expected = campaign[1][2].work.run(range(10))["cost"]
    np.testing.assert_array_equal(larger_store.columns(2, ["cost"])["cost"], expected)
    fewer = Store(full.folder, campaign[1], 4, 3)
    assert list(fewer.missing()) == []
    np.testing.assert_array_equal(fewer.columns(2, ["cost"])["cost"], expected[:4])


def test_a_full_disk_gives_one_line_and_leaves_complete_files_only(
    tmp_path: Path, campaign: Few, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, points = campaign
    store = Store(tmp_path / "out", points, plan.draws, plan.chunk)
    new_file, files = file_access.new_file, []

    @contextmanager
    def fill(path: Path, **options: Any) -> Iterator[IO[bytes]]:
        files.append(path)
        with new_file(path, **options) as file:
            yield file
            if len(files) == 5:
                raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(file_access, "new_file", fill)
    with pytest.raises(MachineError) as error:
        run_campaign(store, run_in_process)
    assert str(error.value).startswith(f"{store.folder}/runs/")
    assert str(error.value).endswith(
        f".parquet: cannot be written: No space left on device; 12 of 28 runs are in "
        f"{store.folder}; the same command continues the campaign"
    )
    assert sum(path.is_file() for path in (store.folder / "runs").rglob("*")) == 4
    monkeypatch.undo()
    assert run_campaign(store, run_in_process) == 16


def use(path: Path, folder: Path, draws: int | None = None) -> int:
    """Run a campaign's missing chunks in its folder; return the number of runs."""
    campaign, points = few_of(path)
    store = Store(folder, points, draws or campaign.draws, campaign.chunk)
    with locked_folder(campaign, base_of(campaign, path)[1], store):
        return run_campaign(store, run_in_process)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("seed", 12, "campaign.seed is 11 there, 12 here"),
        ("settings", {"horizon_s": 2.0}, "campaign.settings.horizon_s is null there, 2.0 here"),
        (
            "axes",
            [{"name": "m", "key": "network.mansd", "values": [1]}],
            "campaign.axes has 2 entries there, 1 here",
        ),
    ],
)
def test_another_campaign_is_refused_in_the_same_folder(
    write: Write, plan: dict[str, Any], tmp_path: Path, key: str, value: Any, expected: str
) -> None:
    folder = tmp_path / "out"
    path = write(plan, draws=1)
    use(path, folder)
    assert use(path, folder) == 0
    with pytest.raises(CallerError) as error:
        use(write(plan, **{"compare": None, "figures": [], key: value}), folder)
    text = str(error.value)
    assert text.startswith(f"{folder}: holds another campaign (")
    assert expected in text
    assert "\n" not in text


def test_a_changed_scenario_makes_another_campaign_and_changed_figures_do_not(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    folder, losses = tmp_path / "out", tmp_path / "lost.txt"
    losses.write_text("0 1 1\n")
    plan["settings"]["network.loss"] = {"model": "trace", "file": "lost.txt"}
    use(write(plan, draws=1), folder)
    plan["axes"][1]["title"] = "threshold"
    presentation = {"figures": [], "compare": None, "draws": 2, "description": "new"}
    assert use(write(plan, **presentation, metrics={"shown": ["cost"]}), folder) == 8
    scenario = tmp_path / "small.toml"
    text = scenario.read_text()
    path = write(plan)
    scenario.write_text(text.replace("mansd = 2", "mansd = 3"))
    with pytest.raises(CallerError, match=r"scenario\.network\.mansd is 2 there, 3 here"):
        use(path, folder)
    scenario.write_text(text)
    losses.write_text("0 1 0\n")
    with pytest.raises(CallerError, match="holds another campaign"):
        use(path, folder)


def test_a_folder_in_use_or_of_other_content_is_refused(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    path = write(plan, draws=1)
    campaign, points = few_of(path)
    store = Store(tmp_path / "out", points, 1, campaign.chunk)
    with (
        locked_folder(campaign, base_of(campaign, path)[1], store),
        pytest.raises(CallerError, match="another noack uses this folder"),
    ):
        use(path, store.folder)
    (tmp_path / "mine" / "runs").mkdir(parents=True)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "summary.json").write_text("{}")  # a run directory
    for folder in ("mine", "run"):
        with pytest.raises(CallerError, match="holds results"):
            use(path, tmp_path / folder)
    assert [entry.name for entry in (tmp_path / "run").iterdir()] == ["summary.json"]
    (tmp_path / "of runs" / "20260101-000000-a").mkdir(parents=True)
    (tmp_path / "of runs" / "20260101-000000-a" / "scenario.toml").write_text("")
    with pytest.raises(CallerError, match="of runs: a folder of run directories; give another --out"):
        use(path, tmp_path / "of runs")
    for text in ("nonsense", '{"arithmetic": 3}'):
        (tmp_path / "mine" / "campaign.json").write_text(text)
        with pytest.raises(CallerError, match=r"campaign\.json: not a manifest of a campaign; "):
            use(path, tmp_path / "mine")
    with pytest.raises(CallerError, match=r"would be 100,000,000 files; .* or a larger chunk"):
        Store(tmp_path, points[:1], 100_000_000, 1)
    with pytest.raises(CallerError, match=r"few\.toml: is not a folder"):
        use(path, path)  # a file, not a folder


def test_a_damaged_parquet_page_gives_one_line_with_the_remedy(full: Store) -> None:
    """Sums over data that the disk has changed would be wrong without a warning."""
    path = full.folder / "runs" / "point-00001" / "draws-000000003.parquet"
    whole = bytearray(path.read_bytes())
    place = whole.find(np.float64(full.columns(1, ["cost"])["cost"][3]).tobytes())
    whole[place] ^= 1
    path.write_bytes(whole)
    with pytest.raises(MachineError, match="is damaged; remove it, and the same"):
        full.columns(1, ["cost"])


def test_runs_of_another_version_are_shown_but_not_extended(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    path, folder = write(plan), tmp_path / "out"
    use(path, folder)
    manifest = json.loads((folder / "campaign.json").read_text())
    manifest["arithmetic"]["numpy"] = "1.0"
    (folder / "campaign.json").write_text(json.dumps(manifest))
    partial_file = folder / "runs" / "point-00000" / ".draws-000000000.parquet.partial"
    partial_file.write_bytes(b"PAR1")  # of a killed run
    assert use(path, folder) == 0
    assert not partial_file.exists()
    with pytest.raises(CallerError, match=r"differ from the existing ones \(numpy is 1\.0 there"):
        use(path, folder, draws=10)
