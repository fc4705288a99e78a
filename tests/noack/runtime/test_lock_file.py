"""Lock files whose process has ended, and several readers at the same time."""

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from noack.core import file_access
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


def test_a_file_is_stale_to_each_of_two_readers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second one looks while the first one has its lock."""
    leave("lab.json")
    found = []

    def and_look(*arguments: Any, **how: Any) -> bool:
        monkeypatch.setattr(private_folder, "lock", file_access.lock)
        locked = file_access.lock(*arguments, **how)
        found.extend(private_folder.live_lock_files("k"))
        return locked

    monkeypatch.setattr(private_folder, "lock", and_look)
    assert private_folder.live_lock_files("k") == found == []


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
