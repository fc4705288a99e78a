"""Limits of the system on a process give one line with the remedy, and no stack trace."""

import errno
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from noack.core.process_limits import exhausted_limit


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
    found = exhausted_limit(error)
    assert (found is None) == (line is None)
    assert (found or "").startswith(line or "")
