"""Limits of the system on a process give one line with the remedy, and no stack trace."""

import errno
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from noack.core.process_limits import exhausted_limit

KINDS = {"files": resource.RLIMIT_NOFILE, "memory": resource.RLIMIT_AS}


def limited(
    folder: Path, kind: str, soft: int, hard: int, *arguments: str
) -> subprocess.CompletedProcess[str]:
    """Run noack under a limit."""
    return subprocess.run(
        [sys.executable, "-m", "cosim.cli", *arguments, "--no-report", "--runs", str(folder)],
        preexec_fn=lambda: resource.setrlimit(KINDS[kind], (soft, hard)),
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
@pytest.mark.parametrize("command", ["run", "simulate"])
@pytest.mark.parametrize(
    ("kind", "limit", "line"),
    [
        (
            "files", 14,
            "at most 14 open files are permitted; a process of a run needs 64: ulimit -n 1024",
        ),
        (
            "memory", 10**9,
            "at most 1 GB of address space are permitted; a process of a run needs 3 GB: "
            "ulimit -v unlimited",
        ),
    ],
)  # fmt: skip
def test_a_run_names_a_limit_that_is_too_low(
    tmp_path: Path, command: str, kind: str, limit: int, line: str
) -> None:
    done = limited(tmp_path, kind, limit, limit, command, "lane_following")
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"noack: {line}\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_the_limit_of_open_files_is_raised_where_that_is_permitted() -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    program = "from noack.core.process_limits import *; require_limits()\n"
    program += "print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])"
    done = subprocess.run(
        [sys.executable, "-c", program],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (14, hard)),
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert int(done.stdout) == 64


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_an_import_without_memory_gives_no_stack_trace(tmp_path: Path) -> None:
    """Which library reaches the limit first depends on the machine."""
    done = limited(tmp_path, "memory", 3 * 10**8, 3 * 10**8, "simulate", "lane_following")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError("Unable to allocate 8 GiB"), "out of memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "out of memory"),
        (ImportError("a.so: failed to map segment from shared object"), "out of memory"),
        (RuntimeError("can't start new thread"), "out of memory"),
        (OSError(errno.EMFILE, "Too many open files"), "too many open files: at most "),
        (OSError(errno.ENOSPC, "No space left on device"), None),
        (ImportError("no module of that name"), None),
        (RuntimeError("a defect"), None),
    ],
)
def test_errors_of_a_limit_are_told_from_others(error: Exception, line: str | None) -> None:
    found = exhausted_limit(error)
    assert (found is None) == (line is None)
    assert (found or "").startswith(line or "")
