"""A command imports no more than it needs: the imports are most of the time that help takes."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

_SHOW = """
import json, sys
def show(*_):
    names = [name for name, one in sys.modules.items() if type(one).__name__ != "_LazyModule"]
    print(json.dumps(names), file=sys.stderr, flush=True)
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
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=150)
    return set(json.loads(done.stderr.splitlines()[-1]))


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["certify", "--help"]])
def test_help_imports_no_large_library(words: list[str]) -> None:
    assert not imported(*words) & {"numpy", "pydantic", "rich", "scipy", "zenoh"}


_LARGE = {
    "asyncio", "cryptography", "jinja2", "matplotlib", "prometheus_client", "pyarrow", "rerun",
    "rich", "scipy", "ssl",
}  # fmt: skip
_BEFORE_THE_START = """
from cosim.cli import main
from cosim.live import launcher
launcher._Run.watch = show
main()
"""
_PROCESSES = """
from cosim.live import fork_server
fork_server._import(fork_server._IMPORTS)
show()
"""


@pytest.mark.parametrize("program", [_BEFORE_THE_START, _PROCESSES])
def test_a_run_begins_without_large_libraries(program: str, tmp_path: Path) -> None:
    """Neither the launcher nor a process imports before the start what it needs only later."""
    modules = imported("run", "lane_following", "--runs", str(tmp_path), program=program)
    assert "numpy" in modules
    assert not modules & _LARGE
    assert [one for one in modules if re.match(r"noack\.theory\.\w+\.", one)] == []
    assert not modules & {"cosim.live.finalize", "cosim.live.progress"}
    assert program is _BEFORE_THE_START or "typer" not in modules
