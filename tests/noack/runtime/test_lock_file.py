"""Lock files whose process has ended, and several readers at the same time."""

import os
import resource
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from noack.core import file_access
from noack.core.errors import CallerError, MachineError
from noack.runtime import private_folder
from noack.runtime.private_folder import open_private


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def leave(*names: str) -> None:
    with open_private("k", create=True) as folder:
        for name in names:
            os.close(folder.create(name))


def names() -> list[str]:
    with open_private("k") as folder:
        return sorted(folder.names())


def test_a_reader_that_was_stopped_removes_no_socket_of_a_new_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It had opened the file of the old process when a new one took the name."""
    leave("lab.json", "lab.sock")
    with ExitStack() as new:

        def stopped(*arguments: Any, **how: Any) -> bool:
            monkeypatch.setattr(private_folder, "lock", file_access.lock)
            new.enter_context(private_folder.lock_file("k", "lab", {}))
            leave("lab.sock", "lab.sock.lock")
            return file_access.lock(*arguments, **how)

        monkeypatch.setattr(private_folder, "lock", stopped)
        private_folder.live_lock_files("k")
        assert names() == ["lab.json", "lab.sock", "lab.sock.lock"]
    assert names() == []


def test_a_file_that_cannot_be_written_leaves_nothing() -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with (
            pytest.raises(MachineError, match=r"lab\.json: cannot be written: File too large"),
            private_folder.lock_file("k", "lab", {"long": "x" * 2000}),
        ):
            raise AssertionError("it was written")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert names() == []


def test_a_missing_runtime_directory_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "none"))
    with pytest.raises(CallerError, match=r"none: no such folder; set XDG_RUNTIME_DIR"):
        names()
