"""Where compiled code is stored, and the behaviour when it cannot be stored."""

import errno
import fcntl
import os
import signal
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NoReturn

import numba
import pytest

from noack.plants.systems.code_cache import _one_at_a_time, cache_folder, compiler

SOURCES = [Path(__file__)]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


@pytest.fixture
def folder(home: Path) -> Path:
    folder = cache_folder("netem", SOURCES)
    assert folder is not None
    return folder


def doubled(number: int) -> int:
    return 2 * number


def test_changed_sources_use_another_folder(home: Path) -> None:
    other = home / "other.py"
    other.write_text("None")
    folders = {cache_folder("netem", sources) for sources in (SOURCES, [*SOURCES, other], SOURCES)}
    assert len(folders) == 2
    other.write_text("pass")
    assert cache_folder("netem", [*SOURCES, other]) not in folders


def test_compiled_code_is_cached(home: Path, folder: Path) -> None:
    assert compiler(folder)(doubled)(21) == 42
    assert list(folder.rglob("*.doubled-*.nbi"))
    assert home in folder.parents


def test_a_second_compilation_waits_for_the_first_and_uses_its_code(folder: Path) -> None:
    later = compiler(folder)(doubled)
    with (folder / ".lock").open("w") as lock, ThreadPoolExecutor() as pool:
        fcntl.flock(lock, fcntl.LOCK_EX)
        result = pool.submit(later, 21)
        # Without the lock the other thread would compile now, and not find code in the cache.
        assert not wait([result], timeout=0.3).done
        numba.config.CACHE_DIR = str(folder)
        assert numba.njit(doubled, cache=True)(21) == 42
        fcntl.flock(lock, fcntl.LOCK_UN)
        assert result.result() == 42
    assert len(later.stats.cache_hits) == 1


def test_empty_cache_files_are_compiled_again(folder: Path) -> None:
    for suffix in ("nbi", "nbc"):
        assert compiler(folder)(doubled)(21) == 42
        (file,) = folder.rglob(f"*.doubled-*.{suffix}")
        file.write_bytes(b"")
        assert compiler(cache_folder("netem", SOURCES))(doubled)(21) == 42
        assert file.stat().st_size > 0


def test_without_a_home_there_is_no_cache(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "file" / "below"))
    assert cache_folder("netem", SOURCES) is None
    function = compiler(None)(doubled)
    assert function(21) == 42
    # numba, under its older rules, has no location of its own for it either
    assert function._cache.cache_path is None


def test_on_a_full_disk_only_an_existing_cache_is_used(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: int) -> NoReturn:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    assert cache_folder("netem", SOURCES) is None
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    folder = cache_folder("netem", SOURCES)
    assert folder is not None
    assert compiler(folder)(doubled)(21) == 42
    monkeypatch.setattr(os, "posix_fallocate", refuse)
    assert cache_folder("netem", SOURCES) == folder


@pytest.mark.usefixtures("usual_signals")
def test_ctrl_c_waits_for_the_compiler(folder: Path) -> None:
    """LLVM calls Python back, and does not survive an exception there."""
    function = compiler(folder)(doubled)
    going_on: list[str] = []
    compile_once = function.compile.__closure__[0].cell_contents  # the code inside the lock

    def interrupted(signature: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        going_on.append("compiled all the same")
        return compile_once(signature)

    function.compile = _one_at_a_time(interrupted, folder / ".lock")
    with pytest.raises(KeyboardInterrupt):
        function(21)
    assert going_on
    assert function(21) == 42  # without recompiling
    assert len(going_on) == 1
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
