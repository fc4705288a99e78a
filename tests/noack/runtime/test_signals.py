"""Signals that end a process, also during its imports."""

import os
import signal
import subprocess
import sys
import time

import pytest

from noack.core.errors import ExitStatus
from noack.runtime.command_line import Signals


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
        (["netem", "netem.channel", "--help"], INT),
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
