"""A signal during the imports ends a program with one line and its status."""

import signal
import subprocess
import sys

import pytest

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


@pytest.mark.parametrize(
    ("number", "status", "why"),
    [
        (signal.SIGINT, 130, "stopped by the user (SIGINT)"),
        (signal.SIGTERM, 143, "stopped on request (SIGTERM)"),
    ],
)
@pytest.mark.parametrize(
    "words",
    [
        ["cosim.cli", "typer", "--version"],
        ["netem", "netem.channel", "--help"],
        ["plant_server", "noack.runtime.run_process", "--help"],
    ],
)
def test_a_signal_during_the_imports_gives_one_line(
    words: list[str], number: signal.Signals, status: int, why: str
) -> None:
    command = [sys.executable, "-c", INTERRUPTED, str(int(number)), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert (done.returncode, done.stdout, done.stderr) == (status, "", f"noack: {why}\n")
