"""Exports of a run, read back by the readers of other programs and compared with the record."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv
from scipy.io import loadmat

import noack
from cosim.output.export.mat_export import save_mat
from tests.helpers.command_line import invoke

SCENARIO: dict[str, Any] = {
    "horizon_s": 1.0, "changes": [{"at_s": 0.5, "set": {"trigger.beta": 0.05}}],
}  # fmt: skip


@pytest.fixture(scope="module")
def run() -> noack.Run:
    return noack.simulate(noack.load("lane_following", SCENARIO))


@pytest.fixture(scope="module")
def loops() -> noack.Run:
    return noack.simulate(noack.load("shared_bottleneck", {"horizon_s": 0.2, "loops.0.count": 2}))


def vector(table: pa.Table, name: str) -> np.ndarray:
    names = [column for column in table.column_names if column.startswith(f"{name}_")]
    return np.column_stack([table[column].to_numpy() for column in names])


def test_a_mat_file_has_the_record(run: noack.Run, tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    assert run.export(path) == [path]
    stored = loadmat(path, simplify_cells=True)
    for name in run.tables:
        table = run.table(name)
        if table.num_rows:
            assert np.array_equal(np.ravel(stored[name]["t_ns"]), table["t_ns"].to_numpy())
    steps = run.table("plant_step")
    assert stored["plant_step"]["x"].tobytes() == vector(steps, "x").tobytes()
    assert stored["plant_step"]["t_ns"].dtype == np.int64
    assert np.array_equal(stored["samples"]["e_c_norm"], run.samples()["e_c_norm"], equal_nan=True)
    assert list(np.atleast_1d(stored["events"]["fate"])) == run.events()["fate"].to_pylist()
    assert stored["summary"]["loops"]["events"] == run.summary.loops[0].events
    assert stored["loop"]["A"].shape == (4, 4)
    assert stored["certificates"]["none"].startswith("changes: needs settings that stay the same")
    assert run.export(path)[0].read_bytes() == path.read_bytes()


def test_any_document_becomes_structures_of_a_mat_file(tmp_path: Path) -> None:
    content = {
        "a b": None, "a_b": [1, 2.5], "1": [[1, 2], [3, 4]], "_x": ["p", "", None], "n" * 80: True,
        "n" * 31 + "x": 2, "n" * 31 + "y": 3,
        "mixed": [[1, 2], [3]], "empty": [], "objects": [{"k": 1}, {"k": "x"}], "text": "‖x‖ é",
    }  # fmt: skip
    save_mat(content, tmp_path / "d.mat")
    stored = loadmat(tmp_path / "d.mat", simplify_cells=True)
    assert stored["a_b"].size == 0
    assert stored["a_b_2"].tolist() == [1, 2.5]
    assert stored["f_1"].tolist() == [[1, 2], [3, 4]]
    assert stored["objects"][1]["k"] == "x"
    assert stored["text"] == "‖x‖ é"
    assert stored["n" * 31] == 1
    assert stored["n" * 27 + "_2"] == 2
    assert stored["n" * 27 + "_3"] == 3
    assert max(map(len, stored)) <= 31


@pytest.mark.usefixtures("no_searches")
def test_files_of_several_loops_have_the_loops_names(loops: noack.Run, tmp_path: Path) -> None:
    name, loop = list(loops.loops.items())[-1]
    steps = loop.table("plant_step")["now_ns"].to_pylist()
    mat = loadmat(loops.export(tmp_path / "a.mat", certificates=False)[0], simplify_cells=True)
    assert mat["loops"][name.replace("-", "_")]["plant_step"]["now_ns"].tolist() == steps
    assert Path(tmp_path / "loops.csv") in loops.save_tables(tmp_path)
    plain = noack.simulate(noack.load("double_integrator", {"horizon_s": 0.1}))
    plain_mat = loadmat(plain.export(tmp_path / "plain.mat")[0], simplify_cells=True)
    assert plain_mat["certificates"]["certificates"][0]["proven"]["bounds"]["x"]["decaying"] > 0
    files = loops.export(tmp_path / "csv")
    assert tmp_path / f"csv/{name}/plant_step.csv" in files


def test_csv_files_have_the_tables(run: noack.Run, tmp_path: Path) -> None:
    words = ["export", str(run.directory), "--format", "csv", "--out", str(tmp_path / "csv")]
    result = invoke(*words, "--json")
    assert result.exit_code == 0, result.output
    names = {Path(file).stem for file in json.loads(result.stdout)["files"]}
    assert names == {*run.tables, "samples", "events"}
    steps = csv.read_csv(tmp_path / "csv/plant_step.csv")
    assert steps.equals(run.loops[run.scenario.name].table("plant_step"))
