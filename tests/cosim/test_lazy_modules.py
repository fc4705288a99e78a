"""Modules that are imported lazily."""

import importlib
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from cosim.lazy_modules import lazy_modules


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A package that appends to ``sys.argv`` what is loaded."""
    folder = tmp_path / "some_package"
    (folder / "inner").mkdir(parents=True)
    for name, rest in (
        ("__init__", ""),
        ("slow", "import time\nfirst = 1\ntime.sleep(0.2)\nsecond = 2\n"),
        ("wrong", "raise RuntimeError\n"),
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


def imported(package: str, name: str) -> ModuleType:
    with lazy_modules():
        return importlib.import_module(f"{package}.{name}")


def test_a_module_is_loaded_when_a_name_of_it_is_used(package: str) -> None:
    module = imported(package, "slow")
    assert sys.argv == []
    assert imported(package, "slow") is module
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
    assert imported(package, "inner.one").name == 2
    assert sys.argv == [f"{package}{name}" for name in ("", ".inner", ".inner.one", ".inner.two")]


def test_another_thread_waits_until_it_is_loaded(package: str) -> None:
    module, found = imported(package, "slow"), []
    threads = [threading.Thread(target=lambda: found.append(module.second)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [2, 2, 2]
    assert sys.argv == [package, f"{package}.slow"]


def test_an_error_is_raised_at_each_use(package: str) -> None:
    module = imported(package, "wrong")
    for _ in range(2):
        with pytest.raises(RuntimeError):
            module.name  # noqa: B018
    with pytest.raises(ModuleNotFoundError):
        imported(package, "missing")
