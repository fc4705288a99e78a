"""Files are written whole, or one line says why not; what is no file is left alone."""

import os
import stat
from pathlib import Path

import pytest

from noack.core.errors import MachineError
from noack.core.file_access import locked, new_file, write_whole


def test_a_file_is_replaced_and_nothing_else_remains(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    write_whole(path, "first")
    assert write_whole(path, b"second").read_bytes() == b"second"
    assert [one.name for one in path.parent.iterdir()] == ["a.txt"]


def test_a_folder_and_a_fifo_are_not_replaced(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for path in (fifo, tmp_path, Path()):
        with pytest.raises(MachineError, match="cannot be written: not a regular file"):
            write_whole(path, "text")
    assert stat.S_ISFIFO(fifo.stat().st_mode)
    assert [one.name for one in tmp_path.iterdir()] == ["fifo"]


@pytest.mark.parametrize("name", ["a\0b", "n" * 300, "\udcff\0"])
def test_a_name_that_no_file_can_have_is_reported(tmp_path: Path, name: str) -> None:
    with pytest.raises(MachineError, match="cannot be written: "):
        write_whole(tmp_path / name, "text")
    assert not list(tmp_path.iterdir())


def test_nothing_that_another_user_has_made_in_the_folder_is_written_to(tmp_path: Path) -> None:
    """Whatever has the name of the new file, or stands at the file's name as a link."""
    (precious := tmp_path / "precious").write_text("secret")
    (folder := tmp_path / "shared").mkdir()
    (path := folder / "a.txt").symlink_to(precious)
    (folder / ".a.txt.partial").symlink_to(precious)
    write_whole(path, "text")
    assert (precious.read_text(), path.read_text(), path.is_symlink()) == ("secret", "text", False)


def test_a_failure_keeps_the_old_file_and_leaves_no_new_one(tmp_path: Path) -> None:
    (path := tmp_path / "a.txt").write_text("old")

    def interrupted() -> None:
        with new_file(path) as file:
            file.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert [one.name for one in tmp_path.iterdir()] == ["a.txt"]


def test_a_lock_file_is_not_a_link(tmp_path: Path) -> None:
    (tmp_path / "lock").symlink_to(tmp_path / "target")
    with pytest.raises(OSError, match="not a regular file"), locked(tmp_path / "lock"):
        pass
    assert not (tmp_path / "target").exists()
    with pytest.raises(OSError, match="none/lock"), locked(tmp_path / "none" / "lock"):
        pass
