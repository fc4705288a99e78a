"""noack neither writes nor loads compiled code in a folder to which another user can write.

numba unpickles the files in its cache, so a user with write access there can run code as this user.
"""

import os
import pickle
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

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


def test_a_sticky_folder_is_allowed_and_the_target_of_a_link_is_checked(
    home: Path, tmp_path: Path
) -> None:
    """In a sticky folder, others can create files but cannot replace or remove this user's."""
    home.parent.mkdir()
    home.parent.chmod(0o1777)
    assert new_folder()
    home.rename(tmp_path / "theirs")
    (tmp_path / "theirs").chmod(0o777)
    home.symlink_to(tmp_path / "theirs")
    assert cache_folder("netem", SOURCES) is None
