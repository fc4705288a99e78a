"""Ctrl-C during the imports ends a program with status 130 and without output."""

import subprocess
import sys

import pytest

INTERRUPTED = """
import os, runpy, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == imported:
            os.kill(os.getpid(), signal.SIGINT)

module, imported, *sys.argv[1:] = sys.argv[1:]
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's & has it ignored
sys.meta_path.insert(0, Interrupt())
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize(
    "words",
    [
        ["cosim.cli", "typer", "--version"],
        ["netem", "netem.duplex_link", "--help"],
        ["plant_server", "noack.runtime.process_entry", "--help"],
    ],
)
def test_interrupt_during_imports_leaves_no_traceback(words: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, *words], capture_output=True, text=True, timeout=200
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
