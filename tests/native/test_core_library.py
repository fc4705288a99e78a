"""The loader of the core, its build, and the names that Python has for those of the public headers."""

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from native.build import HEADER, LIBRARIES, NETEM, is_current
from netem.core.core_library import OWN, address_of, core, dtype_of, ffi, pointer_to
from netem.core.errors import CallerError
from netem.core.packet_rows import Fate
from netem.impairments.feature import StageTables
from netem.impairments.link_settings import Counters
from noack.core import core_library as loop
from tests.netem.impairments.feature_examples import IMPAIRED, names_file

ROOT = Path(__file__).parents[2]


def test_a_pointer_has_the_address_of_its_array() -> None:
    numbers = np.arange(6, dtype=np.int64)
    pointer = pointer_to(numbers, "int64_t *")
    assert (address_of(pointer), pointer[5]) == (numbers.ctypes.data, 5)
    with pytest.raises(ValueError, match="contiguous"):
        pointer_to(numbers[::2], "int64_t *")


def test_a_missing_or_broken_or_other_library_is_refused_in_one_line(tmp_path: Path) -> None:
    own = ffi.string(core.netem_sources())
    other = OWN.path.read_bytes().replace(own, own[::-1])
    for number, content in enumerate((None, b"", b"no library", other)):
        path = tmp_path / f"{number}.so"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(CallerError) as error:
            OWN.load(path)
        says = str(path) if number < 3 else "built from other sources"
        assert says in str(error.value)
        assert "make setup" in str(error.value)
        assert str(error.value).isprintable()


def test_libraries_with_two_versions_of_the_network_are_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("netem.core.core_library.NETWORK", "other sources")
    with pytest.raises(CallerError, match="are of two versions") as error:
        runpy.run_path(loop.__file__)
    assert str(error.value).isprintable()


def test_the_loops_library_takes_the_networks_structures() -> None:
    for name in ("noack_link *", "noack_stage *", "noack_packet_row *", "noack_clock *"):
        assert loop.ffi.typeof(name) is ffi.typeof(name)


def test_a_command_without_the_core_says_so_without_a_traceback(tmp_path: Path) -> None:
    for package in ("noack", "cosim", "netem", "plant_server", "sensor_node", "controller_node"):
        ignored = shutil.ignore_patterns("__pycache__", "_core_header.py")
        shutil.copytree(ROOT / package, tmp_path / package, ignore=ignored)
    done = subprocess.run(
        [sys.executable, "-c", "from cosim.cli import main; main()", "check", "lane_following"],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("noack: noack's core in C")
    assert "make setup" in line


def constants(name: str) -> dict[str, int]:
    """Return the constants of an enumeration."""
    return {word: number for number, word in ffi.typeof(f"enum {name}").elements.items()}


def test_python_has_the_numbers_and_fields_of_c() -> None:
    assert constants("noack_fate") == {f"NOACK_{fate.name}": fate.value for fate in Fate}
    assert dtype_of("noack_counters").names == tuple(Counters.__dataclass_fields__)


def test_each_stage_kind_has_a_file_in_c_and_a_feature_in_python() -> None:
    kinds = [
        name.removeprefix("NOACK_").lower()
        for name, number in constants("noack_stage_kind").items()
        if number != core.NOACK_STAGE_KINDS
    ]
    assert {path.stem for path in (ROOT / "native" / "impairments").glob("*.c")} == set(kinds)
    made = [impairment.stage(StageTables()) for impairment in IMPAIRED if not names_file(impairment)]
    assert {stage.kind for stage in made if stage is not None} == set(kinds)


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


def build(native: Path, *arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Build into the folder beside ``native``."""
    return subprocess.run(
        [sys.executable, native / "build.py", "netem", "--into", native.parent / "core", *arguments],
        env=os.environ | environment, capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip


def files(native: Path) -> dict[str, bytes]:
    core = native.parent / "core"
    return {path.name: path.read_bytes() for path in core.iterdir()}


needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler"
)


def test_the_core_of_this_repository_is_that_of_its_sources() -> None:
    assert all(map(is_current, LIBRARIES.values())), "run `make setup`"


@needs_compiler
def test_a_build_compiles_only_what_has_changed_and_says_so_in_one_line(copy: Path) -> None:
    first = build(copy, "--library-alone")
    assert (first.returncode, first.stderr) == (0, "")
    assert len(first.stdout.splitlines()) == 1
    assert files(copy).keys() == {NETEM.file}
    assert build(copy).stdout == ""  # the declarations, which takes no time
    made = files(copy)
    assert made.keys() == {NETEM.file, HEADER}
    again = build(copy)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    (copy.parent / "core" / HEADER).unlink()
    assert build(copy).stdout == ""
    assert files(copy) == made
    with (copy / "network" / "network.h").open("a") as file:
        file.write("/* changed */\n")
    assert build(copy).stdout == first.stdout
    assert files(copy)[HEADER] != made[HEADER]


def test_noacks_own_core_is_never_a_sanitized_one() -> None:
    command = [sys.executable, ROOT / "native" / "build.py", "--sanitized"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 2
    assert "--into" in done.stderr.splitlines()[-1]
