"""Files are written whole, limits of a process and errors give one printable line."""

import errno
import json
import os
import resource
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.errors import CallerError, MachineError, one_line, printable, why
from noack.core.file_access import locked, new_file, write_whole
from noack.core.system_processes import exhausted_limit


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


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError("Unable to allocate 8 GiB"), "out of memory"),
        (ImportError("a.so: failed to map segment from shared object"), "out of memory"),
        (RuntimeError("can't start new thread"), "out of memory"),
        (OSError(errno.EMFILE, "Too many open files"), "too many open files: at most "),
        (OSError(errno.ENOSPC, "No space left on device"), None),
    ],
)
def test_errors_of_a_limit_are_told_from_others(error: Exception, line: str | None) -> None:
    limit = exhausted_limit(error)
    assert (limit is None) == (line is None)
    assert (limit or "").startswith(line or "")


# --- lines of errors ------------------------------------------------------------------------------


@given(st.text(st.characters(exclude_categories=["Cs"])))  # without surrogates
def test_quoted_text_is_one_printable_line(text: str) -> None:
    assert printable(text).isprintable()
    assert printable(text) == text or not text.isprintable()


def test_control_characters_are_escaped_and_each_mistake_has_a_line() -> None:
    assert str(CallerError("key = \x1b[2J\x07é\ud800")) == "key = \\x1b[2J\\x07é\\ud800"
    assert str(CallerError("a: wrong\nb: \twrong")) == "a: wrong\nb: \\twrong"


def test_an_error_of_another_library_becomes_one_line() -> None:
    assert one_line(ValueError("Couldn't read:\n  no data\n")) == "Couldn't read: no data"


def test_an_error_with_a_file_but_without_a_number_is_its_text(tmp_path: Path) -> None:
    """Python's text is "[Errno None] None: 'FILE'"."""
    error = OSError("not a regular file")
    error.filename = str(tmp_path)
    assert why(error) == "not a regular file"
    (tmp_path / ".lock").symlink_to("elsewhere")
    with pytest.raises(OSError, match=r"^not a regular file$"), locked(tmp_path / ".lock"):
        pass


def test_an_integer_of_thousands_of_digits_is_too_large() -> None:
    """Python's text asks for a change of code."""
    with pytest.raises(ValueError, match="set_int_max_str_digits") as raised:
        json.loads("9" * 5000)
    assert why(raised.value) == one_line(raised.value) == "an integer is too large"
