"""Where compiled code is stored, and the behaviour when it cannot be stored."""

import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

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
    with ThreadPoolExecutor() as pool:
        assert pool.submit(compiler(folder)(doubled), 21).result() == 42
    assert list(folder.rglob("*.doubled-*.nbi"))
    assert home in folder.parents


def test_without_a_home_there_is_no_cache(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "file" / "below"))
    assert cache_folder("netem", SOURCES) is None
    function = compiler(None)(doubled)
    assert function(21) == 42
    # numba, under its older rules, has no location of its own for it either
    assert function._cache.cache_path is None


def test_empty_cache_files_are_compiled_again(folder: Path) -> None:
    for suffix in ("nbi", "nbc"):
        assert compiler(folder)(doubled)(21) == 42
        (file,) = folder.rglob(f"*.doubled-*.{suffix}")
        file.write_bytes(b"")
        assert compiler(cache_folder("netem", SOURCES))(doubled)(21) == 42
        assert file.stat().st_size > 0


@pytest.mark.usefixtures("usual_signals")
def test_ctrl_c_waits_for_the_compiler(folder: Path) -> None:
    """LLVM calls Python back, and does not survive an exception there."""
    compiled = []

    def interrupted(signature: int) -> None:
        signal.raise_signal(signal.SIGINT)
        compiled.append(signature)

    with pytest.raises(KeyboardInterrupt):
        _one_at_a_time(interrupted, folder / ".lock")(1)
    assert compiled == [1]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
