"""A command that writes into a folder of several users follows nothing that another user put there.

At each name that the command writes, and at names that noack has used for a file that is being
written, another user puts a symbolic link or a hard link to a private file, a FIFO, or a folder.
"""

import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb
from typer.testing import CliRunner

import noack
from cosim.cli import app
from cosim.measurement.live.live_measurement import ProbeRows
from cosim.output.viewer.recording import RecordingFile
from cosim.record.run_directory import ENDING_FILE, RECORD, RECORDING_FILE, EndingFile, finished_run
from netem.capture import CaptureWriter
from netem.fates import FateRecorder
from netem.relay_links import LinkSpec
from noack.core.errors import NoackError
from noack.impairments.link_settings import LinkSettings
from noack.runtime.join_ticket import write_invitation
from noack.runtime.spool import SPOOL, SpoolWriter
from noack.scenario.matrix_files import write_matrices
from tests.attacks.other_user import NOBODY, needs_root
from tests.noack.runtime.test_invitation import INVITED

PRIVATE = b"mine alone"
ENDS = ("127.0.0.1", 9000), ("127.0.0.1", 9001)
SPEC = LinkSpec("link", *ENDS, LinkSettings(), LinkSettings())
COMMANDS = (
    "certify lane_weighted --out {out}/cert.mat",
    "certify lane_weighted --tables {out}/tables",
    "archive {run} --out {out}/a.noack.zip",
    "export {run} --format mat --out {out}/run.mat",
    "export {run} --format mcap --out {out}/run.mcap",
    "export {run} --format csv --out {out}/tables",
    "compare {run} {run} --out {out}/compare.html",
    "fidelity {run} --out {out}/fidelity.svg",
    "measure rural_n8_10kmh --out {out}/page.html --format svg --write {out}/network.toml",
    "campaign {campaign} --workers 1 --out {out}/campaign",
)
CAMPAIGN = """\
name = "tiny"
scenario = "lane_following"
seed = 1
draws = 2
[settings]
horizon_s = 1.0
[[axes]]
name = "beta"
key = "trigger.beta"
values = [0.5]
"""


PLANTS: dict[str, Callable[[Path, Path], None]] = {
    "symbolic link": Path.symlink_to,
    "hard link": Path.hardlink_to,
    "FIFO": lambda path, _: os.mkfifo(path),
    "folder": lambda path, _: path.mkdir(),
}
LINKS = ("symbolic link", "hard link")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scenario = noack.load("lane_following", {"horizon_s": 1.0})
    return noack.simulate(scenario, runs=tmp_path_factory.mktemp("runs")).directory


@pytest.fixture
def private(tmp_path: Path) -> Path:
    path = tmp_path / "private" / "precious"
    path.parent.mkdir()
    path.write_bytes(PRIVATE)
    return path


@pytest.fixture
def shared(tmp_path: Path) -> Path:
    """A folder in which every user may write, as in a group without the sticky bit."""
    path = tmp_path / "shared"
    path.mkdir()
    path.chmod(0o777)
    return path


def planted(plant: str, shared: Path, names: Sequence[Path], private: Path) -> None:
    for name in names:
        old = name.with_suffix(name.suffix + ".partial")
        for one in (name, old.with_name(f".{old.name}"), name.with_suffix(".partial")):
            path = shared / one
            path.parent.mkdir(parents=True, exist_ok=True)
            if not os.path.lexists(path):
                PLANTS[plant](path, private)


def untouched(private: Path) -> bool:
    return private.read_bytes() == PRIVATE and [*private.parent.iterdir()] == [private]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_follows_no_planted_name(
    command: str, run: Path, shared: Path, private: Path, tmp_path: Path
) -> None:
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)

    def invoke() -> int:
        places = {"out": str(shared), "run": str(run), "campaign": str(tmp_path / "campaign.toml")}
        done = CliRunner().invoke(app, [word.format(**places) for word in command.split()])
        assert not done.exception or isinstance(done.exception, SystemExit), done.exception
        if done.exit_code:
            assert done.stderr.count("\n") == 1
        return done.exit_code

    assert invoke() == 0
    names = [one.relative_to(shared) for one in shared.rglob("*") if one.is_file()]
    assert names
    # A FIFO or a folder ends a command at the first name; two commands show that.
    for plant in PLANTS if command.startswith("certify") else LINKS:
        shutil.rmtree(shared)
        shared.mkdir()
        planted(plant, shared, names, private)
        status = invoke()
        assert untouched(private), plant
        if status == 0:
            assert not any((shared / name).is_symlink() for name in names)
            assert all((shared / name).stat().st_nlink == 1 for name in names)


def probe_rows(path: Path) -> None:
    with ProbeRows(path, print) as rows:
        rows.add(1, 2)


def lock_file(path: Path) -> None:
    with finished_run(path.parent):
        pass


WRITERS: dict[str, Callable[[Path], object]] = {
    "trace.csv": probe_rows,
    ".lock": lock_file,
    "a.pcapng": lambda path: CaptureWriter(path, [SPEC]).close(),
    "fates.parquet": lambda path: FateRecorder(path, [SPEC]).__exit__(),
    "recording.rrd": lambda path: RecordingFile(path, "a", rrb.Blueprint(), indexed=True).close(),
    ENDING_FILE: lambda path: EndingFile(path.parent).__enter__().__exit__(),
    "plant_step.recorder": lambda path: SpoolWriter(path.parent, "recorder").append(
        "plant_step", 0, b"rows"
    ),
    "invitation.json": lambda path: write_invitation(path, INVITED),
    "a.npz": lambda path: write_matrices(path, {"A": np.eye(2)}),
    "a.mat": lambda path: write_matrices(path, {"A": np.eye(2)}),
}


@needs_root
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_grows_or_is_locked_follows_no_planted_name(
    name: str, plant: str, shared: Path, private: Path
) -> None:
    planted(plant, shared, [Path(name)], private)
    for one in shared.iterdir():
        if plant != "hard link":
            os.chown(one, NOBODY, NOBODY, follow_symlinks=False)
    with suppress(NoackError, OSError):
        WRITERS[name](shared / name)
        assert name == ".lock" or not (shared / name).is_symlink()
    assert untouched(private)


@needs_root
def test_a_folder_that_is_another_users_link_is_not_written_to(shared: Path, private: Path) -> None:
    (shared / "tables").symlink_to(private.parent)
    os.chown(shared / "tables", NOBODY, NOBODY, follow_symlinks=False)
    words = ["certify", "lane_weighted", "--tables", str(shared / "tables")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1
    assert done.stderr.endswith(f"{shared / 'tables'} is a symbolic link of another user\n")
    assert untouched(private)
    os.chown(shared / "tables", os.getuid(), os.getgid(), follow_symlinks=False)
    assert CliRunner().invoke(app, words).exit_code == 0


@pytest.mark.parametrize("name", ["loops", RECORD, ENDING_FILE, RECORDING_FILE, SPOOL])
def test_an_unfinished_run_with_links_is_not_completed(
    name: str, tmp_path: Path, private: Path
) -> None:
    """Of somebody else's run with a loop named "private", the folder of that name was removed."""
    scenario = noack.load("shared_bottleneck", {"horizon_s": 0.2})
    run_dir = noack.simulate(scenario, runs=tmp_path / "runs").directory
    text = (run_dir / "scenario.toml").read_text()
    (run_dir / "scenario.toml").write_text(text.replace('name = "loop-1"', 'name = "private"'))
    (run_dir / "summary.json").unlink()
    (run_dir / SPOOL).mkdir(exist_ok=True)
    if (run_dir / name).is_dir():
        shutil.rmtree(run_dir / name)
    (run_dir / name).unlink(missing_ok=True)
    (run_dir / name).symlink_to(tmp_path)
    done = CliRunner().invoke(app, ["summary", str(run_dir)])
    assert done.exit_code == 2
    assert f"{run_dir / name}: is a symbolic link; a run directory has none" in done.stderr
    assert untouched(private)
