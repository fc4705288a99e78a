"""Processes that a user's program starts without knowing it."""

import subprocess
import sys
from pathlib import Path

_PROGRAM = """
from cosim.live.processes.process_pool import process_starts, processes

print("once", flush=True)
with processes(2) as pool:
    with process_starts():
        futures = [pool.submit(abs, number) for number in (-1, -2, -3)]
    print([future.result() for future in futures])
"""


def test_a_program_without_a_main_guard_is_not_run_again(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(_PROGRAM)
    command = [sys.executable, str(program)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout == "once\n[1, 2, 3]\n"
    assert result.stderr == ""
