"""A command imports no more than it needs: the imports are most of the time that help takes."""

import importlib
import json
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from cosim.lazy_modules import lazy_modules

_SHOW = """
import json, sys
def show(*_):
    names = [name for name, module in sys.modules.items() if type(module).__name__ != "_LazyModule"]
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
from cosim.live.processes import fork_server
fork_server._import(fork_server._IMPORTS)
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


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A package that appends to ``sys.argv`` what is loaded."""
    folder = tmp_path / "some_package"
    (folder / "inner").mkdir(parents=True)
    for name, rest in (
        ("__init__", ""),
        ("slow", "import time\nfirst = 1\ntime.sleep(0.2)\nsecond = 2\n"),
        ("wrong", "raise RuntimeError\n"),
        ("stopped", "if sys.argv.count(__name__) == 1:\n    raise KeyboardInterrupt\nname = 1\n"),
        (
            "outer",
            "from cosim.lazy_modules import lazy_modules\nwith lazy_modules():\n"
            "    from some_package import slow\n",
        ),
        ("inner/__init__", "from some_package.inner.one import name\n"),
        ("inner/one", "from some_package.inner import two\nname = two.name\n"),
        ("inner/two", "name = 2\n"),
    ):
        text = f"import sys\nsys.argv.append(__name__)\n{rest}"
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "argv", [])
    yield folder.name
    for name in [name for name in sys.modules if name.startswith(folder.name)]:
        del sys.modules[name]


def lazily_imported(package: str, name: str) -> ModuleType:
    with lazy_modules():
        return importlib.import_module(f"{package}.{name}")


def test_a_module_is_loaded_when_a_name_of_it_is_used(package: str) -> None:
    module = lazily_imported(package, "slow")
    assert sys.argv == []
    assert lazily_imported(package, "slow") is module
    assert sys.argv == []
    assert module.second == 2
    assert sys.argv == [package, f"{package}.slow"]
    assert type(module) is ModuleType


def test_a_module_that_is_loaded_within_lazy_imports_has_lazy_imports(package: str) -> None:
    with lazy_modules():
        outer = importlib.import_module(f"{package}.outer")
        assert type(outer.slow) is not ModuleType
    assert sys.argv == [package, f"{package}.outer"]
    assert outer.slow.second == 2


def test_a_package_is_loaded_before_its_modules(package: str) -> None:
    assert lazily_imported(package, "inner.one").name == 2
    assert sys.argv == [f"{package}{name}" for name in ("", ".inner", ".inner.one", ".inner.two")]


def test_a_package_is_loaded_before_a_module_that_is_not_imported_lazily(package: str) -> None:
    lazily_imported(package, "inner")
    module = importlib.import_module(f"{package}.inner.two")  # the package imports it, too
    assert sys.argv == [f"{package}{name}" for name in ("", ".inner", ".inner.one", ".inner.two")]
    assert module.__spec__ is not None
    assert module.__spec__.origin == module.__file__


def test_another_thread_waits_until_it_is_loaded(package: str) -> None:
    module, values = lazily_imported(package, "slow"), []
    threads = [threading.Thread(target=lambda: values.append(module.second)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert values == [2, 2, 2]
    assert sys.argv == [package, f"{package}.slow"]


@pytest.mark.parametrize(
    "statement", ["from some_package.stopped import name", "import some_package.stopped"]
)
def test_ctrl_c_while_a_module_is_loaded_is_not_lost(package: str, statement: str) -> None:
    lazily_imported(package, "stopped")
    with pytest.raises(KeyboardInterrupt):
        exec(f"{statement}\nsome_package.stopped.name", {"some_package": sys.modules[package]})
    assert sys.argv == [package, f"{package}.stopped"]


def test_an_error_is_raised_at_each_use(package: str) -> None:
    module = lazily_imported(package, "wrong")
    for _ in range(2):
        with pytest.raises(RuntimeError):
            module.name  # noqa: B018
    with pytest.raises(ModuleNotFoundError):
        lazily_imported(package, "missing")
