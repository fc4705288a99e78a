"""Files are written whole, limits of a process and errors give one printable line."""

import os
import resource
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from netem.core.errors import CallerError, MachineError
from netem.core.file_access import new_file, write_whole


def test_a_folder_and_a_fifo_are_not_replaced(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for path in (fifo, tmp_path, Path()):
        with pytest.raises(MachineError, match="cannot be written: not a regular file"):
            write_whole(path, "text")
    assert stat.S_ISFIFO(fifo.stat().st_mode)
    assert [path.name for path in tmp_path.iterdir()] == ["fifo"]


@pytest.mark.parametrize("name", ["a\0b", "n" * 300, "\udcff\0"])
def test_a_name_that_no_file_can_have_is_reported(tmp_path: Path, name: str) -> None:
    with pytest.raises(MachineError, match="cannot be written: "):
        write_whole(tmp_path / name, "text")
    assert not list(tmp_path.iterdir())


def test_a_failure_keeps_the_old_file_and_leaves_no_new_one(tmp_path: Path) -> None:
    (path := tmp_path / "a.txt").write_text("old")

    def interrupted() -> None:
        with new_file(path) as file:
            file.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


# --- limits of a process --------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
@pytest.mark.parametrize("command", ["run", "simulate"])
def test_a_run_names_a_limit_that_is_too_low(tmp_path: Path, command: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "cosim.cli", command, "lane_following", "--runs", str(tmp_path)],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (14, 14)),
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    line = "at most 14 open files are permitted; a process of a run needs 64: ulimit -n 1024"
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"noack: {line}\n")
    assert list(tmp_path.iterdir()) == []


# --- lines of errors ------------------------------------------------------------------------------


def test_control_characters_are_escaped_and_each_mistake_has_a_line() -> None:
    assert str(CallerError("key = \x1b[2J\x07é\ud800")) == "key = \\x1b[2J\\x07é\\ud800"
    assert str(CallerError("a: wrong\nb: \twrong")) == "a: wrong\nb: \\twrong"
