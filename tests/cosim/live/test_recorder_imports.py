"""A recorder joins a run before it imports the libraries that it needs later."""

import subprocess
import sys


def test_recorder_starts_without_the_libraries_of_its_files() -> None:
    program = "import sys, cosim.live.recorder; print({'pyarrow', 'rerun'} & sys.modules.keys())"
    command = [sys.executable, "-c", program]
    assert subprocess.check_output(command, text=True, timeout=150) == "set()\n"
