"""Compiled code that another user could have planted: it is not kept there, and not loaded.

numba unpickles what it finds in its cache, so that who can write there runs code as the user.
"""

import os
import pickle
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from noack.core.code_cache import cache_folder, compiler
from tests.attacks.other_user import NOBODY, needs_root

SOURCES = [Path(__file__)]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "up" / "cache"))
    return tmp_path / "up" / "cache"


def give_away(path: Path) -> None:
    os.chown(path, NOBODY, NOBODY)


def open_up(path: Path) -> None:
    path.chmod(0o777)


def open_to_the_group(path: Path) -> None:
    path.chmod(0o770)


CHANGES = [pytest.param(give_away, marks=needs_root), open_up, open_to_the_group]


class Payload:
    """What runs a command of the attacker's choice when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return os.mkdir, (str(self.trace),)


def tripled(number: int) -> int:
    return 3 * number


@pytest.mark.parametrize("change", CHANGES)
def test_a_planted_index_is_not_unpickled(
    change: Callable[[Path], None], home: Path, tmp_path: Path
) -> None:
    folder = cache_folder("netem", SOURCES)
    assert folder is not None
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
    change: Callable[[Path], None], level: str, home: Path, tmp_path: Path
) -> None:
    folder = cache_folder("netem", SOURCES)
    assert folder is not None
    change(folder if level == "the folder" else tmp_path / level)
    assert cache_folder("netem", SOURCES) is None


@needs_root
def test_nor_where_a_file_is_another_users(home: Path) -> None:
    folder = cache_folder("netem", SOURCES)
    assert folder is not None
    (folder / "of.another-1.nbi").write_bytes(b"planted")
    give_away(folder / "of.another-1.nbi")
    assert cache_folder("netem", SOURCES) is None


def test_created_folders_are_private(home: Path) -> None:
    before = os.umask(0)
    try:
        folder = cache_folder("netem", SOURCES)
    finally:
        os.umask(before)
    assert folder is not None
    for made in (folder, folder.parent, home, home.parent):
        assert stat.S_IMODE(made.stat().st_mode) == 0o700


@pytest.mark.parametrize("mode", [0o755, 0o775, 0o777])
def test_the_folder_that_an_older_version_left_to_the_umask_is_closed(
    mode: int, home: Path
) -> None:
    before = cache_folder("netem", SOURCES)
    assert before is not None
    (home / "noack").chmod(mode)
    assert cache_folder("netem", SOURCES) == before
    assert stat.S_IMODE((home / "noack").stat().st_mode) == 0o700


@needs_root
@pytest.mark.parametrize("level", ["noack", "noack/below"])
def test_unless_another_user_has_put_his_own_there(level: str, home: Path) -> None:
    """Either the whole folder, or, where he could write, the one in which the code lies."""
    folder = cache_folder("netem", SOURCES)
    assert folder is not None
    folder.parent.chmod(0o777)
    give_away(folder.parent if level == "noack" else folder)
    assert cache_folder("netem", SOURCES) is None


def test_a_cache_below_a_sticky_folder_is_allowed(home: Path) -> None:
    """There others may make files, but neither replace nor remove the user's."""
    home.mkdir(parents=True)
    home.parent.chmod(0o1777)
    assert cache_folder("netem", SOURCES) is not None


def test_a_link_is_followed_to_where_it_is_checked(home: Path, tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs").chmod(0o777)
    home.parent.mkdir()
    home.symlink_to(tmp_path / "theirs")
    assert cache_folder("netem", SOURCES) is None
