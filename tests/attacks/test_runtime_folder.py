"""Folders in which other users may write: they get no access, and no planted name is followed."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun.blueprint as rrb

import noack
from cosim.doctor.machine_measures import _runtime_folder_problem
from cosim.output.viewer.loop_recording import RecordingFile
from cosim.record.run_directory import ENDING_FILE, RECORD, RECORDING_FILE, EndingFile, finished_run
from netem.control import running_emulators as emulators
from netem.core.errors import CallerError, MachineError, NoackError
from netem.core.file_access import (
    create_file,
    create_folder,
    open_growing,
    remove_file,
    remove_folder,
    write_whole,
)
from noack.runtime import active_runs
from noack.runtime.run_descriptor import (
    RunDescriptor,
    descriptor_file,
    find_descriptor,
    new_access,
    new_descriptor,
)
from noack.runtime.spool import SPOOL, SpoolWriter
from noack.scenario.matrix_files import write_matrices
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.attacks.other_user import NOBODY, needs_root
from tests.helpers.command_line import invoke

OWN = f"noack-{os.getuid()}"
EMULATOR = "lab"

_swaps: list[Callable[[str], None]] = []
"""Actions of the other user as this process opens a file; an audit hook cannot be removed."""


def _as_a_file_is_opened(event: str, details: tuple[Any, ...]) -> None:
    if event == "open" and _swaps and str(details[0]).rpartition("/")[2].startswith("default."):
        _swaps.pop()(str(details[0]))


sys.addaudithook(_as_a_file_is_opened)


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files, used without XDG_RUNTIME_DIR."""
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


@pytest.fixture
def descriptor(content: dict[str, Any]) -> RunDescriptor:
    scenario = resolve(validate(content, "small"))
    return new_descriptor(new_access(Path("run"), launched=False), scenario)


def join() -> RunDescriptor:
    descriptor = find_descriptor("default")
    assert descriptor is not None
    return descriptor


Use = Callable[[RunDescriptor], object]
USES: dict[str, Use] = {
    "publish a run descriptor": lambda descriptor: descriptor_file(descriptor, "default").__enter__(),
    "join a run": lambda _: join(),
    "publish a run": lambda descriptor: active_runs.registered_run(descriptor, None).__enter__(),
    "find a run": lambda _: active_runs.find_run(),
    "publish an emulator": lambda _: emulators.registered_emulator(EMULATOR).__enter__(),
    "list emulators": lambda _: emulators.running_emulators(),
}


@pytest.mark.parametrize("use", USES)
def test_a_symbolic_link_instead_of_a_folder_is_refused(
    use: str, shared: Path, descriptor: RunDescriptor
) -> None:
    """Even a link to this user's own folder: its owner can change the target at any time."""
    (shared / "own").mkdir(mode=0o700)
    (shared / "own" / "default.json").write_text(descriptor.model_dump_json())
    (shared / OWN).symlink_to(shared / "own")
    with pytest.raises(CallerError, match="closed to others"):
        USES[use](descriptor)
    assert "closed to others" in str(_runtime_folder_problem())  # the doctor reports it
    assert [file.name for file in (shared / "own").iterdir()] == ["default.json"]


def test_a_descriptor_is_not_written_into_a_folder_swapped_in_meanwhile(
    shared: Path, descriptor: RunDescriptor
) -> None:
    """The swap happens after the folder is checked and before the file is opened."""
    theirs = shared / "theirs"
    theirs.mkdir()

    def swap(_: str) -> None:
        (shared / OWN).rename(shared / "away")
        (shared / OWN).symlink_to(theirs)
        (theirs / f"default.{os.getpid()}").touch(mode=0o666)  # theirs if opened, not created

    with descriptor_file(descriptor, "other"):
        pass  # creates the folder, as an earlier run does
    _swaps.append(swap)
    with descriptor_file(descriptor, "default"):
        assert not _swaps
        assert not any(file.read_text() for file in theirs.iterdir())


@needs_root
@pytest.mark.parametrize("theirs", ["folder", "file"])
def test_a_file_of_another_user_is_not_read(theirs: str, shared: Path, descriptor: RunDescriptor) -> None:
    with descriptor_file(descriptor, "default") as path:
        os.chown(path if theirs == "file" else path.parent, NOBODY, NOBODY)
        with pytest.raises(CallerError, match="of yours"):
            join()


def test_only_regular_files_are_read(shared: Path) -> None:
    """A named pipe would block its reader."""
    (shared / OWN).mkdir(mode=0o700)
    os.mkfifo(shared / OWN / "default.json")
    with pytest.raises(CallerError, match="file of yours"):
        join()


def test_a_run_without_a_usable_folder_is_refused(shared: Path) -> None:
    assert find_descriptor("default") is None
    with pytest.raises(CallerError, match="no run is active"):
        active_runs.find_run()
    assert emulators.running_emulators() == []
    assert not (shared / OWN).exists()


PRIVATE = b"mine alone"
COMMANDS = (
    "export {run} --format mat --out {out}/run.mat",
    "compare {run} {run} --out {out}/compare.html",
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
def common(tmp_path: Path) -> Path:
    """A folder in which every user may write, as in a group without the sticky bit."""
    path = tmp_path / "shared"
    path.mkdir()
    path.chmod(0o777)
    return path


def planted(plant: str, common: Path, names: Sequence[Path], private: Path) -> None:
    for name in names:
        old = name.with_suffix(name.suffix + ".partial")
        for planted_name in (name, old.with_name(f".{old.name}"), name.with_suffix(".partial")):
            path = common / planted_name
            path.parent.mkdir(parents=True, exist_ok=True)
            if not os.path.lexists(path):
                PLANTS[plant](path, private)


def untouched(private: Path) -> bool:
    return private.read_bytes() == PRIVATE and [*private.parent.iterdir()] == [private]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_follows_no_planted_name(
    command: str, run: Path, common: Path, private: Path, tmp_path: Path
) -> None:
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)

    def status_of_command() -> int:
        places = {"out": str(common), "run": str(run), "campaign": str(tmp_path / "campaign.toml")}
        result = invoke(*(word.format(**places) for word in command.split()))
        assert not result.exception or isinstance(result.exception, SystemExit), result.exception
        if result.exit_code:
            assert result.stderr.count("\n") == 1
        return result.exit_code

    assert status_of_command() == 0
    names = [path.relative_to(common) for path in common.rglob("*") if path.is_file()]
    assert names
    shutil.rmtree(common)
    common.mkdir()
    planted("symbolic link", common, names, private)
    status = status_of_command()
    assert untouched(private)
    assert status != 0 or not any((common / name).is_symlink() for name in names)


def lock_file(path: Path) -> None:
    with finished_run(path.parent):
        pass


WRITERS: dict[str, Callable[[Path], object]] = {
    ".lock": lock_file,
    "recording.rrd": lambda path: RecordingFile(path, "a", rrb.Blueprint(), indexed=True).close(),
    ENDING_FILE: lambda path: EndingFile(path.parent).__exit__(None, None, None),
    "plant_step.recorder": lambda path: SpoolWriter(path.parent, "recorder").append("plant_step", 0, b"rows"),
    "a.npz": lambda path: write_matrices(path, {"A": np.eye(2)}),
    "a.mat": lambda path: write_matrices(path, {"A": np.eye(2)}),
}


@needs_root
@pytest.mark.parametrize(
    ("name", "plant"),
    [*((name, "symbolic link") for name in WRITERS), *((ENDING_FILE, plant) for plant in PLANTS)],
)
def test_a_file_that_grows_or_is_locked_follows_no_planted_name(
    name: str, plant: str, common: Path, private: Path
) -> None:
    planted(plant, common, [Path(name)], private)
    for path in common.iterdir():
        if plant != "hard link":
            os.chown(path, NOBODY, NOBODY, follow_symlinks=False)
    with suppress(NoackError, OSError):
        WRITERS[name](common / name)
        assert name == ".lock" or not (common / name).is_symlink()
    assert untouched(private)


OUTPUTS: dict[str, tuple[str, ...]] = {
    "--tables": ("certify", "double_integrator", "--no-search", "--tables", "{}/tables"),
    "--out": ("measure", "rural_n8_10kmh", "--out", "{}/m.html"),
    "--write": ("measure", "rural_n8_10kmh", "--write", "{}/network.toml"),
    "--runs": ("simulate", "double_integrator", "--set", "horizon_s=0.1", "--runs", "{}"),
    "--runs with a folder": ("simulate", "double_integrator", "--set", "horizon_s=0.1", "--runs", "{}/runs"),
    "--out of a campaign": (
        "campaign",
        "mb_vs_zoh",
        "--draws",
        "1",
        "--workers",
        "1",
        "--out",
        "{}/campaign",
    ),
    "a new scenario": ("new", "double_integrator", "--out", "{}/mine.toml"),
}


@needs_root
@pytest.mark.parametrize(("option", "above"), [*((option, "") for option in OUTPUTS), ("--out", "sub")])
def test_no_output_passes_a_link_of_another_user(
    option: str, above: str, common: Path, private: Path
) -> None:
    link = common / "o"
    (private.parent / "sub").mkdir()
    before = sorted(private.parent.rglob("*"))
    link.symlink_to(private.parent)
    os.chown(link, NOBODY, NOBODY, follow_symlinks=False)
    words = [word.format(link / above) for word in OUTPUTS[option]]
    result = invoke(*words)
    assert result.exit_code != 0
    assert f"{link} is a symbolic link of another user" in result.stderr
    assert sorted(private.parent.rglob("*")) == before
    assert private.read_bytes() == PRIVATE


@needs_root
@pytest.mark.parametrize("make", [create_folder, create_file, remove_file, remove_folder])
def test_no_folder_or_file_is_made_or_removed_through_a_link_of_another_user(
    make: Callable[[Path], object], common: Path, private: Path
) -> None:
    (private.parent / "sub").mkdir()
    (link := common / "o").symlink_to(private.parent)
    os.chown(link, NOBODY, NOBODY, follow_symlinks=False)
    before = sorted(private.parent.rglob("*"))
    for path in (link / "new", link / "sub" / "new", link / "sub", link / private.name):
        with suppress(OSError):
            make(path)
    assert sorted(private.parent.rglob("*")) == before
    assert private.read_bytes() == PRIVATE


def test_own_links_on_the_way_are_followed(tmp_path: Path) -> None:
    (tmp_path / "disk" / "deep").mkdir(parents=True)
    (tmp_path / "second").symlink_to("disk")
    (tmp_path / "first").symlink_to(tmp_path / "second" / "deep")
    write_whole(tmp_path / "first" / "new" / ".." / "new" / "a.txt", "text")
    assert (tmp_path / "disk" / "deep" / "new" / "a.txt").read_text() == "text"
    (tmp_path / "stats").symlink_to("first/new/b.txt")
    for text in (b"first", b"next"):
        descriptor = open_growing(tmp_path / "stats", follow=True)
        os.write(descriptor, text)
        os.close(descriptor)
        assert (tmp_path / "disk" / "deep" / "new" / "b.txt").read_bytes() == text


def test_links_in_a_circle_are_an_error(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(MachineError, match="Too many levels of symbolic links"):
        write_whole(tmp_path / "a" / "file", "text")
    with pytest.raises(OSError, match="Too many levels of symbolic links"):
        open_growing(tmp_path / "a", follow=True)


@needs_root
def test_statistics_pass_no_link_of_another_user(common: Path, private: Path) -> None:
    """Behind a link of the user's own, too."""
    (link := common / "o").symlink_to(private.parent)
    os.chown(link, NOBODY, NOBODY, follow_symlinks=False)
    (own := common / "own").symlink_to(link / private.name)
    for path in (link / private.name, own):
        with pytest.raises(OSError, match="is a symbolic link of another user"):
            open_growing(path, follow=True)
    assert untouched(private)


def test_standard_output_can_be_a_growing_file() -> None:
    code = "import os, pathlib; from netem.core.file_access import open_growing;"
    code += "os.write(open_growing(pathlib.Path('/dev/stdout'), follow=True), b'text')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (done.stdout, done.stderr) == (b"text", b"")


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Somebody else's run, with a loop named "private"."""
    loops = [{"name": "private"}, {"name": "other"}]
    scenario = noack.load("double_integrator", {"horizon_s": 0.1, "loops": loops})
    run_dir = noack.simulate(scenario, runs=tmp_path_factory.mktemp("runs")).directory
    (run_dir / "summary.json").unlink()
    return run_dir


@pytest.mark.parametrize("name", ["loops", RECORD, ENDING_FILE, RECORDING_FILE, SPOOL])
def test_an_unfinished_run_with_links_is_not_completed(
    name: str, unfinished: Path, tmp_path: Path, private: Path
) -> None:
    """The folder with the name of a loop was removed."""
    run_dir = Path(shutil.copytree(unfinished, tmp_path / "run"))
    (run_dir / SPOOL).mkdir(exist_ok=True)
    if (run_dir / name).is_dir():
        shutil.rmtree(run_dir / name)
    (run_dir / name).unlink(missing_ok=True)
    (run_dir / name).symlink_to(tmp_path)
    result = invoke("summary", run_dir)
    assert result.exit_code == 2
    assert f"{run_dir / name}: is a symbolic link; a run directory has none" in result.stderr
    assert untouched(private)
