"""Signals that end a process, and its lock file."""

import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from netem.core import file_access, private_folder
from netem.core.command_line import Signals
from netem.core.errors import CallerError, ExitStatus, MachineError
from netem.core.private_folder import open_private


def test_a_second_signal_ends_the_process_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = time.monotonic_ns()
    with Signals().handled() as signals:
        for _ in range(3):  # forwarded several times, it counts once
            os.kill(os.getpid(), signal.SIGTERM)
        assert signals.received == signal.SIGTERM
        monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns + 10**10)
        with pytest.raises(SystemExit) as ended:
            os.kill(os.getpid(), signal.SIGTERM)
    assert ended.value.code is ExitStatus.TERMINATED


@pytest.mark.parametrize("ignored", [False, True])
def test_sighup_ends_a_process_unless_nohup_ignores_it(ignored: bool) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    try:
        with Signals().handled() as signals:
            os.kill(os.getpid(), signal.SIGHUP)
            assert signals.received == (None if ignored else signal.SIGHUP)
            assert signals.status is (ExitStatus.OK if ignored else ExitStatus.TERMINATED)
    finally:
        signal.signal(signal.SIGHUP, before)


INTERRUPTED = """
import os, runpy, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == imported:
            os.kill(os.getpid(), int(number))

number, module, imported, *sys.argv[1:] = sys.argv[1:]
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's & has it ignored
sys.meta_path.insert(0, Interrupt())
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""


INT = (signal.SIGINT, 130, "stopped by the user (SIGINT)")
TERM = (signal.SIGTERM, 143, "stopped on request (SIGTERM)")


@pytest.mark.parametrize(
    ("words", "ended"),
    [
        (["cosim.cli", "typer", "--version"], INT),
        (["netem", "netem.core.system_processes", "--help"], INT),
        (["netem", "netem.stand_alone", "--listen", ":0", "--to", ":9"], INT),
        (["netem", "netem.measurement.measure_command", "measure", "x"], INT),
        (["noack.network_process", "noack.machines.channel", "--help"], INT),
        (["plant_server", "noack.runtime.run_process", "--help"], TERM),
    ],
)
def test_a_signal_during_the_imports_gives_one_line(
    words: list[str], ended: tuple[signal.Signals, int, str]
) -> None:
    number, status, why = ended
    command = [sys.executable, "-c", INTERRUPTED, str(int(number)), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert (done.returncode, done.stdout, done.stderr) == (status, "", f"noack: {why}\n")


# --- lock files -----------------------------------------------------------------------------------


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


def test_a_missing_runtime_directory_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "none"))
    with pytest.raises(CallerError, match=r"none: no such folder; set XDG_RUNTIME_DIR"):
        names()
