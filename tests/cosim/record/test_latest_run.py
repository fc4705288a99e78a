"""``latest`` is followed if link and run belong to the user; otherwise the owner is reported."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.api.runs import open_run
from cosim.record.run_directory import (
    LATEST,
    SCENARIO_FILE,
    chosen_run,
    file_of_loop,
    latest_run,
    loop_of_file,
    new_run_dir,
    point_to_latest,
)
from noack.core.errors import CallerError

ANOTHER_UID = 65_534
ROOT = Path(__file__).parents[3]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A folder that everybody may write to, where users remove only their own files, as in /tmp."""
    folder = tmp_path / "runs"
    for name in ("first", "second"):
        (folder / name).mkdir(parents=True)
        (folder / name / SCENARIO_FILE).write_text("")
    folder.chmod(0o1777)
    return folder


def require_root() -> None:
    if os.geteuid() != 0:
        pytest.skip("only root may give a file to another user")


@pytest.mark.parametrize("whose", ["link", "run"])
def test_a_run_of_another_user_is_not_opened(runs: Path, whose: str) -> None:
    require_root()
    point_to_latest(runs / "first")
    os.chown(
        runs / (LATEST if whose == "link" else "first"), ANOTHER_UID, -1, follow_symlinks=False
    )
    for opened in (
        lambda: latest_run(runs),
        lambda: chosen_run(runs / LATEST, Path("elsewhere")),
        lambda: open_run(runs / LATEST),
    ):
        with pytest.raises(CallerError, match=rf"^{runs / LATEST}: .* is another user's; name the"):
            opened()
    assert chosen_run(runs / "first", runs) == runs / "first"  # the link's name identifies the run


def test_a_link_that_cannot_be_replaced_is_reported(runs: Path) -> None:
    require_root()
    point_to_latest(runs / "first")
    # A relative path: the other user may lack access to the parent folders.
    script = (
        "import os, pathlib, sys, cosim.record.run_directory;"
        "os.chdir(sys.argv[1]); os.setuid(int(sys.argv[2]));"
        "cosim.record.run_directory.point_to_latest(pathlib.Path('second'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(runs), str(ANOTHER_UID)],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stderr == (
        "noack: warning: latest cannot be replaced: Operation not permitted; "
        "this run is in second\n"
    )
    assert (runs / LATEST).readlink() == Path("first")
    assert sorted(path.name for path in runs.iterdir()) == ["first", "latest", "second"]


def test_names_of_folders_and_of_files_of_loops(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"r\xff")
    for refused in (lambda: new_run_dir(folder, "x"), lambda: chosen_run(folder, tmp_path)):
        with pytest.raises(CallerError, match="is not UTF-8; rename it"):
            refused()
    for name in (None, "a", "b-1"):
        assert loop_of_file(file_of_loop("report.html", name), "report.html") == name
