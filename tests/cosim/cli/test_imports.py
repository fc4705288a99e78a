"""A command imports no more than it needs: the imports are most of the time that help takes."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

_SHOW = """
import json, sys
def show(*_):
    print(json.dumps([*sys.modules]), file=sys.stderr, flush=True)
    sys.exit()
"""
_PROGRAM = """
from contextlib import suppress
from cosim.cli import main
with suppress(SystemExit):
    main()
show()
"""


def imported(*words: str, program: str = _PROGRAM) -> set[str]:
    """The modules that a program loads."""
    command = [sys.executable, "-c", f"{_SHOW}{program}", *words]
    process = subprocess.run(command, capture_output=True, text=True, check=True, timeout=150)
    return set(json.loads(process.stderr.splitlines()[-1]))


_INTERRUPTED = """
import os, signal
from cosim.cli import main
before = {name for name in sys.modules if name.startswith(("cosim.", "noack", "typing"))}
class Interrupt:
    def find_spec(self, *_):
        os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
print(*sorted(before), flush=True)
main()
"""


def test_ctrl_c_during_the_imports_of_a_command_is_quiet() -> None:
    command = [sys.executable, "-S", "-c", f"import sys{_INTERRUPTED}", "check", "lane_following"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=150)
    assert (process.returncode, process.stderr) == (-signal.SIGINT, "")  # to a shell: 130
    assert process.stdout == "cosim.cli\n"


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["certify", "--help"]])
def test_help_imports_no_large_library(words: list[str]) -> None:
    assert not imported(*words) & {"numpy", "pyarrow", "scipy", "zenoh"}


_LARGE = {
    "asyncio", "cryptography", "jinja2", "matplotlib", "pyarrow", "rerun",
    "rich", "scipy", "ssl",
}  # fmt: skip
_BEFORE_THE_START = """
from cosim.cli import main
from cosim.live import launcher
launcher._Run.watch = show
main()
"""
_PROCESSES = """
import cosim.live.processes.process_imports
show()
"""


@pytest.mark.parametrize("program", [_BEFORE_THE_START, _PROCESSES])
def test_a_run_begins_without_large_libraries(program: str, tmp_path: Path) -> None:
    """Neither the launcher nor a process imports before the start what it needs only later."""
    modules = imported("run", "lane_following", "--runs", str(tmp_path), program=program)
    assert "numpy" in modules
    assert not modules & _LARGE
    assert [module for module in modules if re.match(r"noack\.theory\.\w+\.", module)] == []
    assert not modules & {"cosim.live.finalize", "cosim.live.monitoring.progress"}
    assert program is _BEFORE_THE_START or "typer" not in modules
