"""noack neither loads nor imports code from folders to which another user can write."""

import os
import pickle
import re
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cosim.output.viewer.recording_viewer import LiveView
from noack.plants.systems.code_cache import cache_folder, compiler
from tests.attacks.other_user import NOBODY, needs_root

SOURCES = [Path(__file__)]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "up" / "cache"))
    return tmp_path / "up" / "cache"


def new_folder() -> Path:
    folder = cache_folder("netem", SOURCES)
    assert folder is not None
    return folder


def give_away(path: Path) -> None:
    os.chown(path, NOBODY, NOBODY)


def open_up(path: Path) -> None:
    path.chmod(0o777)


def open_to_the_group(path: Path) -> None:
    path.chmod(0o770)


CHANGES = [pytest.param(give_away, marks=needs_root), open_up, open_to_the_group]
Change = Callable[[Path], None]


class Payload:
    """Unpickling this object runs the attacker's command."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return os.mkdir, (str(self.trace),)


def tripled(number: int) -> int:
    return 3 * number


@pytest.mark.parametrize("change", CHANGES[:2])
def test_a_planted_index_is_not_unpickled(change: Change, home: Path, tmp_path: Path) -> None:
    folder = new_folder()
    assert compiler(folder)(tripled)(7) == 21
    (index,) = folder.rglob("*.tripled-*.nbi")
    version = pickle.loads(index.read_bytes())
    planted = pickle.dumps(version) + pickle.dumps(Payload(tmp_path / "trace"))
    change(folder)
    index.write_bytes(planted)
    assert compiler(cache_folder("netem", SOURCES))(tripled)(7) == 21
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize("level", ["up", "up/cache", "the folder"])
@pytest.mark.parametrize("change", CHANGES)
def test_no_cache_below_a_folder_that_others_may_write(
    change: Change, level: str, home: Path, tmp_path: Path
) -> None:
    folder = new_folder()
    change(folder if level == "the folder" else tmp_path / level)
    assert cache_folder("netem", SOURCES) is None


@needs_root
@pytest.mark.parametrize("theirs", ["a file", "the folder", "noack"])
def test_no_cache_with_a_file_or_folder_of_another_user(theirs: str, home: Path) -> None:
    folder = new_folder()
    if theirs == "a file":
        (folder / "of.another-1.nbi").write_bytes(b"planted")
        give_away(folder / "of.another-1.nbi")
    else:
        folder.parent.chmod(0o777)
        give_away(folder.parent if theirs == "noack" else folder)
    assert cache_folder("netem", SOURCES) is None


def test_folders_are_private_and_made_so(home: Path) -> None:
    before = os.umask(0)
    try:
        folder = new_folder()
    finally:
        os.umask(before)
    for made in (folder, folder.parent, home, home.parent):
        assert stat.S_IMODE(made.stat().st_mode) == 0o700
    for mode in (0o755, 0o777):
        (home / "noack").chmod(mode)
        assert new_folder() == folder
        assert stat.S_IMODE((home / "noack").stat().st_mode) == 0o700


def test_a_sticky_folder_is_allowed_and_the_target_of_a_link_is_checked(home: Path, tmp_path: Path) -> None:
    """In a sticky folder, others can create files but cannot replace or remove this user's."""
    home.parent.mkdir()
    home.parent.chmod(0o1777)
    assert new_folder()
    home.rename(tmp_path / "theirs")
    (tmp_path / "theirs").chmod(0o777)
    home.symlink_to(tmp_path / "theirs")
    assert cache_folder("netem", SOURCES) is None


ROOT = Path(__file__).parents[2]
PACKAGES = ("noack", "plant_server", "sensor_node", "controller_node", "netem", "cosim", "tools")
SHADOWED = ("socket", "logging", "multiprocessing", "http", "pickle", "concurrent", "fcntl")
POOL = """
from cosim.live.processes.process_pool import processes
if __name__ == "__main__":
    with processes(2) as pool:
        print(pool.submit(pow, 2, 5).result())
"""


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Enter a folder with modules that write a trace file when imported; return its path."""
    folder, trace = tmp_path / "planted", tmp_path / "trace"
    folder.mkdir()
    for name in SHADOWED:
        (folder / f"{name}.py").write_text(f"open({str(trace)!r}, 'a').write('{name} ')\n")
    monkeypatch.chdir(folder)
    return trace


def test_planted_modules_are_imported_without_protection(planted: Path) -> None:
    subprocess.run([sys.executable, "-c", "import pickle"], check=True)
    assert planted.read_text() == "pickle "


def test_the_live_viewers_process_imports_no_planted_module(planted: Path) -> None:
    recording = planted.with_name("recording.rrd")
    recording.write_bytes(b"RRF2")
    live = LiveView(native=False)
    live.show(recording)
    status = live.status
    live.close()
    assert not planted.exists(), planted.read_text()
    assert status.startswith("live view: http://127.0.0.1:")


def test_workers_import_no_planted_module(planted: Path) -> None:
    """The program ``noack`` starts them; its own folder is not the current folder."""
    program = planted.with_name("program.py")
    program.write_text(POOL)
    result = subprocess.run(
        [sys.executable, program], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert not planted.exists(), planted.read_text()
    assert result.stdout == "32\n", result.stderr


def test_only_one_function_starts_the_interpreter() -> None:
    """A call that names the interpreter directly could omit ``-P``."""
    naming = [
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        if re.search(r"\bsys\.executable\b", path.read_text())
    ]
    assert naming == ["noack/core/system_processes.py"]
