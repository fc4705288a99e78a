"""Archives of runs: the same bytes, a bit-exact repetition, and one line for a hostile file."""

import hashlib
import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import noack
from cosim.studies.run_archive import MANIFEST, write_archive
from noack.core.errors import CallerError
from noack.protocol.record_tables import OWNER
from tests.helpers.command_line import invoke

PLANT = """\
class Lag:
    states = ("x", "v")
    inputs = ("u",)

    def __init__(self, *arguments, **settings):
        pass

    def derivative(self, t_s, x, u):
        return (x[1], u[0])
"""
Files = dict[str, bytes]


@pytest.fixture(scope="module")
def run() -> noack.Run:
    return noack.simulate(noack.load("lane_following", {"horizon_s": 3.0}))


@pytest.fixture(scope="module")
def archive(run: noack.Run) -> Path:
    return run.archive(run.directory.parent / "a.noack.zip")


def files_of(archive: Path) -> Files:
    with zipfile.ZipFile(archive) as file:
        return {name: file.read(name) for name in file.namelist()}


def write(path: Path, files: Files, *, kind: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", kind) as file:
        for name, content in files.items():
            file.writestr(name, content)
    return path


def checked(files: Files) -> Files:
    """The files with a manifest that fits them."""
    manifest = json.loads(files[MANIFEST])
    manifest["files"] = {
        name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        for name, content in files.items()
        if name != MANIFEST
    }
    return files | {MANIFEST: json.dumps(manifest).encode()}


def test_the_same_run_gives_the_same_bytes(run: noack.Run, archive: Path, tmp_path: Path) -> None:
    copy = tmp_path / "elsewhere"
    shutil.copytree(run.directory, copy)
    (copy / "notes.txt").write_text("mine")
    write_archive(copy, tmp_path / "b.noack.zip")
    assert (tmp_path / "b.noack.zip").read_bytes() == archive.read_bytes()
    assert {"scenario.toml", "environment.json", "summary.json"} < files_of(archive).keys()


def test_a_simulated_run_is_repeated_bit_for_bit(archive: Path, run: noack.Run) -> None:
    repetition = noack.reproduce(archive)
    assert repetition.bit_exact
    assert (repetition.differences, repetition.changes, repetition.numbers) == ([], [], [])
    assert repetition.compared == sum(run.table(name).num_rows for name in run.tables)


def test_several_loops_are_repeated_bit_for_bit(tmp_path: Path) -> None:
    loops = noack.simulate(noack.load("shared_bottleneck", {"horizon_s": 0.2, "loops.0.count": 2}))
    repetition = noack.reproduce(loops.archive(tmp_path / "a.zip"))
    assert repetition.bit_exact
    shared = [name for name in loops.tables if OWNER[name] == "netem"]
    rows = sum(loops.table(name).num_rows for name in shared)
    for run in loops.loops.values():
        rows += sum(run.table(name).num_rows for name in run.tables)
    assert repetition.compared == rows


@pytest.mark.usefixtures("without_viewer")
def test_a_live_run_is_replayed_beside_a_simulation(tmp_path: Path) -> None:
    live = noack.run(noack.load("lane_following", {"horizon_s": 0.2, "ports": {}}))
    repetition = noack.reproduce(live.archive(tmp_path / "a.zip"))
    assert (repetition.kind, repetition.compared) == ("live", live.replay().inputs)
    assert repetition.bit_exact


def test_a_repetition_names_what_differs(archive: Path, tmp_path: Path) -> None:
    files = files_of(archive)
    scenario = files["scenario.toml"].replace(b"beta = 0.5", b"beta = 0.25")
    environment = json.loads(files["environment.json"])
    environment["packages"]["numpy"] = "1.0"
    changed = {"scenario.toml": scenario, "environment.json": json.dumps(environment).encode()}
    path = write(tmp_path / "b.zip", checked(files | changed))
    words = ["reproduce", str(path), "--into", str(tmp_path / "i")]
    result = invoke(*words, "--json")
    assert result.exit_code == 1, result.output
    repetition = json.loads(result.stdout)
    assert not repetition["bit_exact"]
    assert "sensor_measurement row 0, threshold: the row differs" in repetition["differences"][0]
    assert repetition["changes"][0].startswith("numpy was 1.0, is ")
    assert "transmissions" in [row[0] for row in repetition["numbers"]]
    assert (tmp_path / "i/archived/summary.json").is_file()
    result = invoke(*words)
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    result = invoke("reproduce", path)
    assert "not reproduced" in result.stdout


def compressed(files: Files, path: Path) -> Path:
    return write(path, files, kind=zipfile.ZIP_DEFLATED)


def overlapping(files: Files, path: Path) -> Path:
    """A second entry in the directory of the file, with the content of the first."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("scenario.toml", files["scenario.toml"] * 100)
        for name in ("summary.json", "reports.json"):
            info = zipfile.ZipInfo(name)
            first = file.filelist[0]
            info.file_size, info.compress_size = first.file_size, first.compress_size
            info.header_offset, info.CRC = first.header_offset, first.CRC
            file.filelist.append(info)
    return path


def damaged(files: Files, path: Path) -> Path:
    """A byte of an entry is another one, and the CRC of ZIP fits."""
    content = bytearray(files["summary.json"])
    content[10] ^= 1
    return write(path, files | {"summary.json": bytes(content)})


def twice(files: Files, path: Path) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("summary.json", files["summary.json"])
        with pytest.warns(UserWarning, match="Duplicate"):
            file.writestr("summary.json", files["summary.json"])
    return path


def renamed(name: str) -> Callable[[Files, Path], Path]:
    return lambda files, path: write(path, checked(files | {name: b"x"}))


def with_claim(key: str, value: str) -> Callable[[Files, Path], Path]:
    """Say something else in the manifest than the files do."""

    def make(files: Files, path: Path) -> Path:
        return write(
            path,
            files | {MANIFEST: json.dumps(json.loads(files[MANIFEST]) | {key: value}).encode()},
        )

    return make


def with_rows(files: Files, path: Path) -> Path:
    """Put five million equal rows, a few kilobytes, in the place of a table."""
    name, rows = "record/plant_step.parquet", io.BytesIO()
    table = pq.read_table(io.BytesIO(files[name]))
    large_table = pa.table({
        column.name: pa.repeat(table[column.name][0], 5_000_000) for column in table.schema
    })  # fmt: skip
    pq.write_table(large_table.cast(table.schema), rows, compression="zstd")
    assert len(rows.getvalue()) < 2_000_000
    return write(path, checked(files | {name: rows.getvalue()}))


def with_horizon(files: Files, path: Path) -> Path:
    text = files["scenario.toml"].replace(b"horizon_s = 3.0", b"horizon_s = 1e7")
    return write(path, checked(files | {"scenario.toml": text}))


def with_beta(files: Files, path: Path) -> Path:
    text = files["scenario.toml"].replace(b"beta = 0.5", b"beta = -0.5")
    return write(path, checked(files | {"scenario.toml": text}))


def fifo(files: Files, path: Path) -> Path:
    os.mkfifo(path)
    return path


HOSTILE: dict[str, tuple[Callable[[Files, Path], Path], str]] = {
    "traversal": (renamed("../../evil"), "not the name of a file in a run directory"),
    "absolute": (renamed("/etc/evil"), "not the name of a file in a run directory"),
    "drive": (renamed("C:\\evil"), "not the name of a file in a run directory"),
    "control characters": (renamed("record/\x1b[31m"), "not the name of a file"),
    "deep": (renamed("record/a/b"), "an archive has no such file"),
    "compressed": (compressed, "is compressed; noack's archives are not"),
    "overlapping": (overlapping, "its entries overlap"),
    "damaged": (damaged, "summary.json: is damaged: its SHA-256 is not that of archive.json"),
    "twice": (twice, "summary.json: is there twice"),
    "extra file": (
        lambda files, path: write(path, files | {"record/more": b""}), "do not have the same files"
    ),
    "no manifest": (
        lambda files, path: write(path, {"summary.json": b"{}"}), "has no archive.json"
    ),
    "no scenario": (
        lambda files, path: write(
            path, checked({name: files[name] for name in (MANIFEST, "summary.json")})
        ),
        "has no scenario.toml",
    ),
    "deep JSON": (
        lambda files, path: write(path, files | {MANIFEST: b"[" * 100_000}),
        "archive.json: content: Invalid JSON",
    ),
    "another kind": (with_claim("kind", "live"), "describes another run than the archive contains"),
    "another name": (with_claim("scenario", "\x1b[31mred"), "describes another run"),
    "rows without end": (with_rows, "plant_step.parquet: has 5,000,000 rows; a run of this"),
    "a device": (lambda files, path: Path("/dev/zero"), "not a regular file"),
    "a FIFO": (fifo, "not a regular file"),
    "a wrong scenario": (with_beta, "b.zip: scenario.toml: trigger.beta"),
    "a long run": (with_horizon, "would take about 138.9 hours"),
    "no file": (lambda files, path: path, "No such file or directory"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_archive_gives_one_line(case: str, archive: Path, tmp_path: Path) -> None:
    make, message = HOSTILE[case]
    path = make(files_of(archive), tmp_path / "b.zip")
    result = invoke("reproduce", path, "--into", tmp_path / "into")
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith(f"noack: {path}: ")
    assert message in result.stderr
    assert str(tmp_path / "into") not in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.rglob("evil"))


def test_code_runs_only_on_request_and_only_from_the_archive(tmp_path: Path) -> None:
    (tmp_path / "lag.py").write_text(PLANT)
    scenario = noack.load("double_integrator").model_dump(mode="json", exclude_none=True)
    scenario["plant"].pop("draw")
    scenario["plant"]["system"] = {
        "kind": "python", "file": str(tmp_path / "lag.py"), "name": "Lag"
    }  # fmt: skip
    path = noack.simulate(noack.load(scenario, {"horizon_s": 0.2})).archive(tmp_path / "a.zip")
    (tmp_path / "lag.py").rename(tmp_path / "moved.py")
    with pytest.raises(CallerError, match=r"contains code \(plant\.system: lag\.py\).*--run-code"):
        noack.reproduce(path)
    assert noack.reproduce(path, run_code=True).bit_exact
    files = files_of(path)
    elsewhere = files["scenario.toml"].replace(b"plant/lag.py", bytes(tmp_path / "moved.py"))
    path = write(path, checked(files | {"scenario.toml": elsewhere}))
    with pytest.raises(CallerError, match=r"names .*moved\.py, which is not in the archive"):
        noack.reproduce(path, run_code=True)
