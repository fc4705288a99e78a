"""The build of the core: only if something has changed, whole or not at all, with any compiler."""

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from native.build import HEADER, LIBRARY, NO_COMPILER, is_current

ROOT = Path(__file__).parents[2]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the folder native with few C files, which builds in a moment.

    The core does not need the others to be a library: it is not loaded.
    """
    native = Path(shutil.copytree(ROOT / "native", tmp_path / "native"))
    for path in native.rglob("*.c"):
        if path.name == "states.c":
            path.write_text("")
        elif path.name not in ("link.c", "elementary.c"):
            path.unlink()
    program = (native / "build.py").read_text()
    assert '"-O3"' in program
    (native / "build.py").write_text(program.replace('"-O3"', '"-O0"'))
    return native


def build(
    native: Path, *arguments: str | Path, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Build into the folder beside ``native``."""
    return subprocess.run(
        [sys.executable, native / "build.py", "--into", native.parent / "core", *arguments],
        env=os.environ | environment, capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip


def files(native: Path) -> dict[str, bytes]:
    core = native.parent / "core"
    return {path.name: path.read_bytes() for path in core.iterdir()}


needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler"
)


def test_the_core_of_this_repository_is_that_of_its_sources() -> None:
    assert is_current(), "run `make setup`"


@needs_compiler
def test_it_builds_only_what_has_changed_and_says_so_in_one_line(copy: Path) -> None:
    first = build(copy, "--library")
    assert (first.returncode, first.stderr) == (0, "")
    assert len(first.stdout.splitlines()) == 1
    assert files(copy).keys() == {LIBRARY}
    assert build(copy).stdout == ""  # the declarations, which takes no time
    made = files(copy)
    assert made.keys() == {LIBRARY, HEADER}
    again = build(copy)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    (copy.parent / "core" / HEADER).unlink()
    assert build(copy).stdout == ""
    assert files(copy) == made
    with (copy / "core.h").open("a") as file:
        file.write("/* changed */\n")
    assert build(copy).stdout == first.stdout
    assert files(copy)[HEADER] != made[HEADER]


@needs_compiler
def test_a_mistake_leaves_the_earlier_core_as_it_was(copy: Path) -> None:
    build(copy)
    made = files(copy)
    with (copy / "link.c").open("a") as file:
        file.write("int mistake(\n")
    done = build(copy)
    assert done.returncode == 1
    assert "link.c" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("the core cannot be built")
    assert files(copy) == made


@needs_compiler
def test_of_two_builds_at_a_time_one_finds_it_built(copy: Path) -> None:
    """What a killed build has left is removed."""
    left = copy.parent / "core" / ".building-x"
    left.mkdir(parents=True)
    (left / LIBRARY).write_bytes(b"half of")
    with ThreadPoolExecutor() as pool:
        done = list(pool.map(build, [copy, copy]))
    assert [one.returncode for one in done] == [0, 0]
    assert sorted(len(one.stdout.splitlines()) for one in done) == [0, 1]
    assert files(copy).keys() == {LIBRARY, HEADER}


def test_without_a_compiler_it_says_what_to_install(copy: Path, tmp_path: Path) -> None:
    """Without the installed packages (-S), among them ziglang; test_same_bits.py builds with it."""
    command = [sys.executable, "-S", copy / "build.py", "--into", copy.parent / "core"]
    done = subprocess.run(
        command, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False,
        timeout=100,
    )  # fmt: skip
    assert done.returncode == NO_COMPILER
    (line,) = done.stderr.splitlines()
    assert "gcc" in line
    assert "ziglang" in line


def test_noacks_own_core_is_never_a_sanitized_one() -> None:
    command = [sys.executable, ROOT / "native" / "build.py", "--sanitized"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 2
    assert "--into" in done.stderr.splitlines()[-1]
